"""Pictures of results; needs the extra `app`."""

from jaxreg.plot.figure import reconstruction_figure as reconstruction_figure
from jaxreg.plot.graph import graph_figure as graph_figure
