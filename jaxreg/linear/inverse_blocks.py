"""Blocks of the inverse of a graph Laplacian, for few frames of many.

Each takes k columns of a solve in float64: by a sparse factor on the host where that
stays small, by multigrid elsewhere. On a chain of 100,000 frames with 1 % of closures
factors take a second, and conjugate gradients had not converged after 300 rounds: long
bends are too soft for cycles. On a grid of as many factors take 5 GB, and gradients a
dozen rounds a frame.

For forces B and solutions X that leave R = B - A X, the block is B' X + X' R: it lacks
E' A E where X lacks E, so it has twice the digits of X.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import lineax as lx
import numpy as np
from jaxtyping import Array, Float

from jaxreg._core.programs import kept_program
from jaxreg.linear.carried import carried_back
from jaxreg.linear.multigrid import Multigrid, multigrid
from jaxreg.linear.operator import GraphLaplacian
from jaxreg.linear.solvers import MultigridCG
from jaxreg.linear.sparse import (
    definite_factor,
    from_blocks,
    kept_unknowns,
    order_and_fill,
)


# Cycles and numbers in both factors, at most: 2 GB with their places. To count these
# is a factor by itself, of minutes and gigabytes where many cycles are of all lengths.
_MOST_CYCLES, _MOST_FILL = 10_000, 150_000_000
# Of multigrid, and what a block may lack, as a share of its diagonal.
_TOLERANCE, _MAX_STEPS, _LACKING = 3e-3, 100, 1e-4
# Blocks are held in all directions if their least eigenvalue, scaled, is above.
_HELD = 1e-12

_Solve = Callable[[int], tuple[np.ndarray, bool]]


def inverse_blocks(
    matrix: GraphLaplacian, frames: np.ndarray
) -> Float[np.ndarray, "p k k"]:
    """Blocks on the diagonal of the inverse with x_0 = 0.

    Args:
        matrix: of `GraphLaplacian.anchored`, without damping, with points, concrete and
            in float64, which must be switched on. Frames that nothing holds may be in
            it; all that are held must be joined to frame 0.
        frames: `(p,)` numbers of frames that are held.

    Returns:
        `(p, k, k)`, of frame 0 zero; NaN where there is no inverse, or none was found.
    """
    k = matrix.own.shape[-1]
    out = np.full((len(frames), k, k), np.nan)
    leaves = jax.tree.leaves(matrix)
    if not all(np.isfinite(np.asarray(x)).all() for x in leaves):
        return out
    solve = _by_factor(matrix) or _by_multigrid(matrix)
    own = np.asarray(matrix.blocks()[frames])
    for n, frame in enumerate(frames):
        if frame == 0:
            out[n] = 0
        elif _is_held(own[n]):
            block, sure = solve(int(frame))
            out[n] = block if sure else np.nan
    return out


def _is_held(block: np.ndarray) -> bool:
    """In all directions, whatever the units."""
    diagonal = np.diagonal(block)
    if not np.all(diagonal > 0):
        return False
    root = np.sqrt(diagonal)
    return bool(np.linalg.eigvalsh(block / root / root[:, None])[0] > _HELD)


def _by_factor(matrix: GraphLaplacian) -> _Solve | None:
    """Solves by a factor; None if it would be too large."""
    num, k = matrix.own.shape[:2]
    used = np.any(np.asarray(matrix.weight) != 0, axis=(1, 2))
    edges = np.asarray(matrix.edges)[used]
    if len(edges) - len(np.unique(edges)) >= _MOST_CYCLES:
        return None
    order, fill = order_and_fill(edges, num)
    if fill * k**2 > _MOST_FILL:
        return None
    blocks, across = np.array(matrix.blocks()), np.asarray(matrix.across())[used]
    blocks[~blocks.any(axis=(1, 2))] = np.eye(k)
    (i, j), frame = edges.T, np.arange(num)
    back = across.swapaxes(1, 2)
    parts = [(frame, frame, blocks), (j, i, -across), (i, j, -back)]
    kept = kept_unknowns(order, k, np.zeros(0, int))
    A = from_blocks(parts, num, k)[kept][:, kept]
    factor = definite_factor(A)

    def solve(frame: int) -> tuple[np.ndarray, bool]:
        B = np.asarray(_balanced(matrix, frame)).reshape(num * k, k)[kept]
        if factor is None:
            return np.full((k, k), np.nan), False
        X = factor.solve(B)
        R = B - A @ X
        return _concluded(_Products(B.T @ X, X.T @ R, R.T @ factor.solve(R)))

    return solve


def _by_multigrid(matrix: GraphLaplacian) -> _Solve:
    """Solves by conjugate gradients."""
    inverse = _cycle(matrix)

    def solve(frame: int) -> tuple[np.ndarray, bool]:
        products, converged = _gradients(
            matrix, inverse, jnp.asarray(frame), _MAX_STEPS
        )
        block, sure = _concluded(jax.tree.map(np.asarray, products))
        return block, sure and bool(converged)

    return solve


class _Products(NamedTuple):
    """Of right-hand sides B, solutions X, what they leave, R, and M like the inverse.

    Arrays of float64, (k, k).
    """

    found: Any  # B' X
    left: Any  # X' R
    lacking: Any  # R' M R


def _concluded(products: _Products) -> tuple[np.ndarray, bool]:
    """A block, and whether it is one."""
    block = products.found + products.left
    block = (block + block.T) / 2
    lacks = np.diagonal(products.lacking) <= _LACKING * np.diagonal(block)
    return block, bool(np.all(lacks) and np.all(np.diagonal(block) > 0))


@kept_program
def _cycle(matrix: GraphLaplacian) -> Multigrid:
    return multigrid(matrix)


@kept_program
def _gradients(
    matrix: GraphLaplacian, inverse: Multigrid, frame: Array, max_steps: int
) -> tuple[_Products, Array]:
    k = matrix.own.shape[-1]
    B = _balanced(matrix, frame)
    solver = MultigridCG(_TOLERANCE, max_steps)
    X, result, _ = solver.compute((matrix, inverse), B, {})
    R = B - matrix.mv(X)
    b, x, r, z = (M.reshape(-1, k) for M in (B, X, R, inverse(R)))
    return _Products(b.T @ x, x.T @ r, r.T @ z), result == lx.RESULTS.successful


def _balanced(matrix: GraphLaplacian, frame: Array | int) -> Float[Array, "v k k"]:
    """Unit forces on a frame, and on frame 0 what holds them."""
    assert matrix.origin is not None
    eye = jnp.eye(matrix.own.shape[-1], dtype=matrix.own.dtype)
    back = carried_back(eye, matrix.origin[frame] - matrix.origin[0])
    rhs = jnp.zeros_like(matrix.own).at[frame].add(eye)
    return rhs.at[0].add(-back)
