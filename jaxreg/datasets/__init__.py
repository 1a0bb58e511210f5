"""Data that the package makes itself, with known truth."""

from jaxreg.datasets.letters import letter_offset as letter_offset
from jaxreg.datasets.letters import word_points as word_points
from jaxreg.datasets.sculpture import sculpture_scans as sculpture_scans
from jaxreg.datasets.solids import cube_points as cube_points
from jaxreg.datasets.solids import horse_like_points as horse_like_points
from jaxreg.datasets.solids import truck_front as truck_front
from jaxreg.datasets.solids import truck_points as truck_points
