"""Pictures and pages of results; needs the extra `app`."""

from jaxreg.app.plot.figure import draw_reconstruction as draw_reconstruction
from jaxreg.app.plot.figure import save_figure as save_figure
from jaxreg.app.plot.graph import draw_graph as draw_graph
from jaxreg.app.plot.report import write_report as write_report
from jaxreg.app.plot.report_graph import write_graph_report as write_graph_report
