"""Point clouds: thinned, described and measured inside `jit`."""

from jaxreg.cloud.described import Described as Described
from jaxreg.cloud.frames import OTHER_UNIT as OTHER_UNIT
from jaxreg.cloud.frames import Frames as Frames
from jaxreg.cloud.frames import Side as Side
from jaxreg.cloud.noise import without_noise as without_noise
from jaxreg.cloud.point_cloud import PointCloud as PointCloud
from jaxreg.cloud.point_cloud import centroid as centroid
from jaxreg.cloud.point_cloud import levelled as levelled
from jaxreg.cloud.point_cloud import rms_radius as rms_radius
from jaxreg.cloud.range_image import RangeImage as RangeImage
from jaxreg.cloud.thin import estimate_normals as estimate_normals
from jaxreg.cloud.thin import thin as thin
from jaxreg.geometry.spacing import median_spacing as median_spacing
