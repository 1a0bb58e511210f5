"""Pictures of results; needs the extra `app`."""

from jaxreg.plot.figure import reconstruction_figure as reconstruction_figure
