"""Reading and writing scans, poses, graphs and results."""

from jaxreg.io.atomic import atomic_write as atomic_write
from jaxreg.io.errors import InputError as InputError
