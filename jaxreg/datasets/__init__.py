"""Data that the package makes itself, with known truth."""

from jaxreg.datasets.sculpture import sculpture_scans as sculpture_scans
