"""Reading and writing scans, poses, graphs and results."""

from jaxreg.io.atomic import atomic_folder as atomic_folder
from jaxreg.io.atomic import atomic_write as atomic_write
from jaxreg.io.atomic import require_writable as require_writable
from jaxreg.io.errors import InputError as InputError
from jaxreg.io.errors import MissingExtraError as MissingExtraError
from jaxreg.io.ply import write_ply as write_ply
from jaxreg.io.points import read_points as read_points
from jaxreg.io.points import read_scans as read_scans
from jaxreg.io.stanford import read_conf as read_conf
