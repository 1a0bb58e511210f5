"""Reading and writing scans, poses, graphs and results."""

from jaxreg.io.atomic import atomic_folder as atomic_folder
from jaxreg.io.atomic import atomic_write as atomic_write
from jaxreg.io.atomic import require_writable as require_writable
from jaxreg.io.errors import InputError as InputError
from jaxreg.io.errors import MissingExtraError as MissingExtraError
from jaxreg.io.g2o import read_g2o as read_g2o
from jaxreg.io.g2o import read_g2o_poses as read_g2o_poses
from jaxreg.io.g2o import write_g2o as write_g2o
from jaxreg.io.kitti import read_kitti as read_kitti
from jaxreg.io.kitti import write_kitti as write_kitti
from jaxreg.io.ply import write_ply as write_ply
from jaxreg.io.points import read_points as read_points
from jaxreg.io.points import read_scans as read_scans
from jaxreg.io.redwood import read_info as read_info
from jaxreg.io.redwood import read_log as read_log
from jaxreg.io.redwood import write_log as write_log
from jaxreg.io.result import Result as Result
from jaxreg.io.result import write_result as write_result
from jaxreg.io.stanford import read_conf as read_conf
from jaxreg.io.toro import read_toro as read_toro
from jaxreg.io.tum import read_tum as read_tum
from jaxreg.io.tum import write_tum as write_tum
