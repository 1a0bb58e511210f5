"""Reading and writing scans, poses, graphs and results."""

from jaxreg.io.atomic import atomic_folder as atomic_folder
from jaxreg.io.atomic import atomic_write as atomic_write
from jaxreg.io.atomic import require_writable as require_writable
from jaxreg.io.errors import InputError as InputError
from jaxreg.io.errors import MissingExtraError as MissingExtraError
from jaxreg.io.g2o import read_g2o as read_g2o
from jaxreg.io.g2o import read_g2o_poses as read_g2o_poses
from jaxreg.io.g2o import write_g2o as write_g2o
from jaxreg.io.ply import write_ply as write_ply
from jaxreg.io.points import read_points as read_points
from jaxreg.io.points import read_scans as read_scans
from jaxreg.io.result import Result as Result
from jaxreg.io.result import write_result as write_result
from jaxreg.io.stanford import read_conf as read_conf
from jaxreg.io.tum import read_tum as read_tum
from jaxreg.io.tum import write_tum as write_tum
