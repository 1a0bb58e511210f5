"""Pictures and pages of results; needs the extra `app`."""

from jaxreg.plot.figure import reconstruction_figure as reconstruction_figure
from jaxreg.plot.graph import graph_figure as graph_figure
from jaxreg.plot.report import write_report as write_report
from jaxreg.plot.report_graph import write_graph_report as write_graph_report
