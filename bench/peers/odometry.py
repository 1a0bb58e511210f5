"""Odometry by KISS-ICP: each frame on a map of those before, from the last motion."""

import importlib
from typing import Any

import numpy as np


#: What KISS-ICP takes for its range of 100 m, in metres.
VOXEL = 1.0


def kiss_odometry(scans: list[np.ndarray]) -> np.ndarray:
    """Poses `(v, 4, 4)` in the frame of scan 0; nothing moves within a scan."""
    lib: Any = importlib.import_module("kiss_icp.kiss_icp")
    config: Any = importlib.import_module("kiss_icp.config").KISSConfig()
    config.data.deskew = False
    config.mapping.voxel_size = VOXEL
    odometry, poses = lib.KissICP(config), []
    for scan in scans:
        odometry.register_frame(np.asarray(scan, float), np.zeros(len(scan)))
        poses.append(odometry.last_pose)
    return np.stack(poses)
