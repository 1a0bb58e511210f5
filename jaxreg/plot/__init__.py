"""Pictures and pages of results; needs the extra `app`."""

from jaxreg.plot.figure import draw_reconstruction as draw_reconstruction
from jaxreg.plot.figure import save_figure as save_figure
from jaxreg.plot.graph import draw_graph as draw_graph
from jaxreg.plot.report import write_report as write_report
from jaxreg.plot.report_graph import write_graph_report as write_graph_report
