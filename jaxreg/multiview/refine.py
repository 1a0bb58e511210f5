"""Joint refinement: all poses move together until all overlapping pairs agree.

The point-to-plane errors of every overlapping pair are linearised at the current poses
and solved as one Gauss-Newton system in all poses at once. It is the averaging of the
relative motions that ICP would measure, each with its own 6 x 6 information: the MCC
paper's chain, pairs then averaging, closed into a loop.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from jaxreg._core.typing import Scalar
from jaxreg.geometry import lie
from jaxreg.local import Problem, match, score, turn_and_shift
from jaxreg.local.residuals import weighted_gram
from jaxreg.multiview.scans import PreparedScans
from jaxreg.neighbours import AbstractIndex, exact_index
from jaxreg.robust import GemanMcClure


# Kernel widths in sample spacings: first by the voxel tables, then by exact search.
_TABLE_WIDTHS = (1.4, 1.2, 1.0, 0.8, 0.7, 0.7)
_EXACT_WIDTHS = (0.55, 0.5, 0.4, 0.35, 0.35)


@eqx.filter_jit
def refine_jointly(
    scans: PreparedScans,
    T_world_i: Float[Array, "v D D"],
    placed: Bool[Array, " v"],
    min_overlap: Scalar,
) -> Float[Array, "v D D"]:
    """Refines the poses of the placed scans; frame 0 of the world may drift.

    Args:
        scans: prepared scans.
        T_world_i: poses of the centred frames.
        placed: scans that take part.
        min_overlap: pairs that agree on a lesser share of the source are left out.

    Returns:
        Poses; those of scans that take no part are unchanged.
    """
    pairs = _ordered_pairs(scans.num_scans)
    spacing = jnp.max(jnp.where(placed, scans.spacing, 0))

    def problem(pair: Array, exact: bool) -> Problem:
        i, j = pair
        source, target = scans.cloud(j), scans.cloud(i)
        index: AbstractIndex = scans.table(i)
        if exact:
            index = exact_index(target.points.shape[0]).build(
                target.points, target.mask
            )
        return Problem.of(source, target, index)

    def overlapping(T: Array) -> Array:
        def one(pair: Array) -> Array:
            T_i_j = lie.inverse(T[pair[0]]) @ T[pair[1]]
            fit = score(problem(pair, exact=False), T_i_j, spacing).fitness
            return placed[pair[0]] & placed[pair[1]] & (fit > min_overlap)

        return lax.map(one, pairs)

    def iterate(T: Array, widths: tuple[float, ...], *, exact: bool) -> Array:
        use = overlapping(T)

        def step(T: Array, width: Array) -> tuple[Array, None]:
            def one(at: tuple[Array, Array]) -> tuple[Array, Array]:
                pair, used = at
                k = lie.tangent_dim(T.shape[-1] - 1)
                zero = jnp.zeros((2 * k, 2 * k), T.dtype), jnp.zeros(2 * k, T.dtype)
                return lax.cond(
                    used,
                    lambda: _pair_equations(problem(pair, exact), T, pair, width),
                    lambda: zero,
                )

            blocks = lax.map(one, (pairs, use))
            return _solve(T, pairs, *blocks), None

        scaled = spacing * jnp.asarray(widths, T.dtype)
        return lax.scan(step, T, scaled)[0]

    T = iterate(T_world_i, _TABLE_WIDTHS, exact=False)
    return lie.orthonormalise(iterate(T, _EXACT_WIDTHS, exact=True))


def _ordered_pairs(num_scans: int) -> Int[Array, "e 2"]:
    i, j = np.nonzero(~np.eye(num_scans, dtype=bool))
    return jnp.asarray(np.stack([i, j], axis=1), jnp.int32)


def _pair_equations(
    problem: Problem, T_world_i: Array, pair: Array, width: Array
) -> tuple[Float[Array, "two_k two_k"], Float[Array, " two_k"]]:
    """H and b of a pair for the tangents of source j and target i, in the world.

    A pose moves by R -> exp(w) R, t -> t + v, so a source point y = R_j p + t_j moves
    by v_j + w_j x (R_j p), the target point likewise, and the residual is
    n . (z - y) with the target's normal.
    """
    T_i, T_j = T_world_i[pair[0]], T_world_i[pair[1]]
    found = match(problem, lie.inverse(T_i) @ T_j)
    weight = GemanMcClure().weight(found.sq_residual, width) * found.agreement
    R_i = lie.rotation(T_i)
    d = R_i.shape[0]
    normal = R_i @ found.normal
    lever_j = lie.rotation(T_j) @ problem.source
    lever_i = R_i @ problem.target[found.row, :d].T
    rows = [
        normal,
        _turn(lever_j, normal),
        -normal,
        -_turn(lever_i, normal),
        found.plane_residual[None],
    ]
    gram = weighted_gram(jnp.concatenate(rows), weight)
    return gram[:-1, :-1], gram[:-1, -1]


def _turn(x: Float[Array, "d n"], n: Float[Array, "d n"]) -> Float[Array, "r n"]:
    """X cross n, the derivative of n . (w cross x) in w."""
    if x.shape[0] == 2:
        return (x[0] * n[1] - x[1] * n[0])[None]
    return jnp.cross(x, n, axis=0)


def _solve(
    T_world_i: Array, pairs: Array, H_pairs: Array, b_pairs: Array
) -> Float[Array, "v D D"]:
    """One Gauss-Newton step in all poses."""
    v, d = T_world_i.shape[0], T_world_i.shape[-1] - 1
    k = lie.tangent_dim(d)
    columns = jnp.concatenate(
        [pairs[:, 1:] * k + jnp.arange(k), pairs[:, :1] * k + jnp.arange(k)], axis=1
    )
    H = jnp.zeros((v * k, v * k), T_world_i.dtype)
    H = H.at[columns[:, :, None], columns[:, None, :]].add(H_pairs)
    b = jnp.zeros(v * k, T_world_i.dtype).at[columns].add(b_pairs)
    # The damping fixes the gauge and poses that no pair determines.
    level = 1e-5 * jnp.trace(H) / (v * k) + jnp.finfo(H.dtype).tiny ** 0.5
    factor = jax.scipy.linalg.cho_factor(H + level * jnp.eye(v * k, dtype=H.dtype))
    tangent = jax.scipy.linalg.cho_solve(factor, b).reshape(v, k)
    return jax.vmap(turn_and_shift)(T_world_i, tangent)
