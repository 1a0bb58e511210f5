from .figure import draw_reconstruction as draw_reconstruction
from .figure import save_figure as save_figure
from .graph import draw_graph as draw_graph
from .report import write_report as write_report
from .report_graph import write_graph_report as write_graph_report
