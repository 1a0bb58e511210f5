"""Rigid registration of 2D and 3D point sets in JAX, without an initial guess.

    register      the pose of one point set in the frame of another
    average       one pose per frame from relative motions
    reconstruct   many scans into one frame

Each is a free function that takes a frozen *method object* and returns a *Solution* of
arrays, which passes through `jit`, `vmap`, `scan` and pickling.

# Conventions

Points:
    `(n, d)`, d = 2 or 3, read from the array; batches add leading axes. What is valid
    is a mask, never a ragged list.

Motions:
    Homogeneous matrices `(..., d+1, d+1)`. `T_target_source` maps source coordinates
    to target coordinates. `T_world_i` is the pose of frame i, and
    `T_i_j = inv(T_world_i) @ T_world_j` maps frame j into frame i. The MCC paper's M_i
    is `T_world_i`, its M_ij is `T_i_j`.

Tangents:
    Translation first, then rotation; k = 3 in 2D, 6 in 3D. Updates are on the left:
    `T <- exp(v) T`.

Quaternions:
    Named `wxyz` or `xyzw`. g2o and TUM files hold xyzw.

Units:
    Lengths in the unit of the input, angles in radians, degrees only in names that end
    in `_deg`. Defaults that are lengths are derived from the data, so the same scans in
    mm and in m give the same answer.

Randomness:
    An explicit `key`. No global state; nothing is configured on import.

Precision:
    The result has the dtype of the input, float32 or float64.

Graphs:
    A g2o edge `i j` holds `T_i_j`, as does a block `i j n` of a 3DMatch `.log`. An
    Open3D pose-graph edge (s, t) is the g2o edge `t s`.

Failure:
    A wrong shape, dtype or option raises while tracing. Numerical failure is a value:
    `sol.status`, one per lane, with `Status(int(sol.status)).advice`.

Static and traced:
    Counts and classes in a method object are static, changing one compiles again.
    Numbers (tolerances, widths, scales) are traced, changing one does not.
"""

import lazy_loader


# Names are in the stub beside this file, and imported when they are first used: who
# asks for help, a version, or what a file holds, need not wait for JAX.
__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)

__version__ = "0.1.0"
