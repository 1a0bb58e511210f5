"""Small dense matrices, many at once, without LAPACK.

Elimination is unrolled, eigenvectors come from Jacobi's rotations: products and sums of
whole arrays, which XLA fuses over the batch, on any device. LAPACK is called matrix by
matrix, which takes ten times as long; and on a CPU two batched calls of one program
that do not depend on each other can wait for each other for ever.

Reference: Golub, Van Loan, Matrix Computations: 8.5 (Jacobi), 8.6.3 (one-sided Jacobi).
"""

import functools

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

from jaxreg._core import control


def product(
    A: Float[Array, "*#b p q"], B: Float[Array, "*#b q r"]
) -> Float[Array, "*b p r"]:
    """A @ B for many small matrices: a sum over the inner index, term by term.

    400,000 products of 4 x 4 take 10 ms on one CPU core; as a sum over an axis of a
    broadcast product 100, by `einsum` 340.
    """
    A, B = of_one_rank(A, B)
    columns, rows = (jnp.split(x, A.shape[-1], axis) for x, axis in ((A, -1), (B, -2)))
    terms = [a * b for a, b in zip(columns, rows, strict=True)]
    return sum(terms[1:], terms[0])


def of_one_rank(a: Array, b: Array) -> list[Array]:
    """Both with as many axes, new ones first."""
    rank = max(a.ndim, b.ndim)
    return [jnp.expand_dims(x, tuple(range(rank - x.ndim))) for x in (a, b)]


def cross(a: Array, b: Array, axis: int = -1) -> Array:
    """Cross products of 3-vectors along an axis, entry by entry.

    Rows that are moved on by one instead take three times as long to compile on a CPU,
    and more than twice as long to run.
    """
    x, y = (jnp.unstack(v, axis=axis) for v in of_one_rank(a, b))
    ways = (1, 2), (2, 0), (0, 1)
    return jnp.stack([x[i] * y[j] - x[j] * y[i] for i, j in ways], axis)


def after(x: Array, earlier: Array) -> Array:
    """The same x, computed after `earlier`: a chain for two calls of LAPACK.

    NaN where `earlier` is, which keeps the compiler from seeing through it.
    """
    first = earlier.reshape(-1)[0]
    return jnp.where(first == first, x, first.astype(x.dtype))


def inverse(A: Float[Array, "*b n n"]) -> Float[Array, "*b n n"]:
    """Inverses of 2 x 2 and 3 x 3 matrices by their cofactors.

    Inf or NaN where a determinant is zero.
    """
    n = A.shape[-1]
    if n == 2:
        (a, b), (c, d) = entries(A)
        cofactors = [[d, -b], [-c, a]]
        determinant = a * d - b * c
    else:
        x = entries(A)
        # Entry (i, j) of the adjugate leaves out row j and column i.
        cofactors = [
            [
                x[(j + 1) % 3][(i + 1) % 3] * x[(j + 2) % 3][(i + 2) % 3]
                - x[(j + 1) % 3][(i + 2) % 3] * x[(j + 2) % 3][(i + 1) % 3]
                for j in range(3)
            ]
            for i in range(3)
        ]
        determinant = sum(
            (x[0][k] * cofactors[k][0] for k in range(1, 3)), x[0][0] * cofactors[0][0]
        )
    return _stacked([[entry / determinant for entry in row] for row in cofactors])


def solve_semidefinite(
    A: Float[Array, "*b k k"], b: Float[Array, "*b k"]
) -> Float[Array, "*b k"]:
    """Solves A x = b for positive semidefinite A by the factors L D L^T.

    A pivot that is zero up to rounding is a direction that A leaves free: it gets no
    part of the solution, which stays finite.

    Args:
        A: `(..., k, k)`, of which the lower triangles are read.
        b: `(..., k)`.
    """
    k = b.shape[-1]
    L, pivots = _factors(A)
    x = list(jnp.unstack(b, axis=-1))
    for i in range(k):
        x[i] = x[i] - sum(L[i][m] * x[m] for m in range(i))
    x = [x[i] * pivots[i] for i in range(k)]
    for i in reversed(range(k)):
        for m in range(i + 1, k):
            x[i] = x[i] - L[m][i] * x[m]
    return jnp.stack(x, axis=-1)


def inverse_semidefinite(A: Float[Array, "*b k k"]) -> Float[Array, "*b k k"]:
    """Inverses of positive semidefinite matrices, zero in the directions left free.

    Positive semidefinite up to rounding, whatever the condition: M^T D^-1 M with M the
    inverse of the factor L of A = L D L^T. The lower triangles are read.
    """
    k = A.shape[-1]
    L, pivots = _factors(A)
    M: list[list[Array]] = []
    for i in range(k):
        row = []
        for j in range(i):
            entry = L[i][j]
            for m in range(j + 1, i):
                entry = entry + L[i][m] * M[m][j]
            row.append(-entry)
        M.append([*row, jnp.ones_like(pivots[i])])
    rows = [
        [
            sum(
                (M[m][i] * pivots[m] * M[m][j] for m in range(max(i, j) + 1, k)),
                M[max(i, j)][i] * pivots[max(i, j)] * M[max(i, j)][j],
            )
            for j in range(k)
        ]
        for i in range(k)
    ]
    return _stacked(rows)


def log_det(A: Float[Array, "*b k k"]) -> Float[Array, "*b"]:
    """Logarithms of the determinants of positive definite matrices.

    The lower triangles are read.
    """
    _, pivots = _factors(A)
    return -sum((jnp.log(p) for p in pivots[1:]), jnp.log(pivots[0]))


def root_semidefinite(
    A: Float[Array, "*b k k"], b: Float[Array, "*b k"]
) -> tuple[Float[Array, "*b k k"], Float[Array, "*b k"]]:
    """R and r with R^T R = A and R^T r = b, for positive semidefinite A.

    R = D^1/2 L^T of the factors A = L D L^T. Rows of directions that A leaves free, and
    what of b is along these, are zero. The lower triangles are read.
    """
    k = b.shape[-1]
    L, pivots = _factors(A)
    x = list(jnp.unstack(b, axis=-1))
    for i in range(k):
        x[i] = x[i] - sum(L[i][m] * x[m] for m in range(i))
    shrink = [jnp.sqrt(p) for p in pivots]
    grow = [jnp.where(p > 0, 1 / jnp.where(p > 0, p, 1), 0) for p in shrink]
    zero = jnp.zeros_like(pivots[0])
    rows = [
        [zero] * i + [grow[i]] + [grow[i] * L[j][i] for j in range(i + 1, k)]
        for i in range(k)
    ]
    return _stacked(rows), jnp.stack([shrink[i] * x[i] for i in range(k)], axis=-1)


def _factors(A: Array) -> tuple[list[list[Array]], list[Array]]:
    """Rows of L below its unit diagonal, and the inverse pivots; zero for free ones."""
    k, lower = A.shape[-1], entries(A)
    largest = functools.reduce(jnp.maximum, (lower[i][i] for i in range(k)))
    least = k * jnp.finfo(A.dtype).eps * largest
    L: list[list[Array]] = [[] for _ in range(k)]
    LD: list[list[Array]] = [[] for _ in range(k)]
    inverted: list[Array] = []
    for i in range(k):
        for j in range(i + 1):
            entry = lower[i][j]
            for m in range(j):
                entry = entry - LD[i][m] * L[j][m]
            LD[i].append(entry)
            if j < i:
                L[i].append(entry * inverted[j])
        fixed = LD[i][i] > least
        inverted.append(jnp.where(fixed, 1 / jnp.where(fixed, LD[i][i], 1), 0))
    return L, inverted


def num_sweeps(dtype: jnp.dtype, size: int = 3) -> int:
    """Sweeps of Jacobi's rotations after which no more than rounding is left.

    Convergence is quadratic: one sweep doubles the digits. Measured on random, singular
    and clustered matrices up to size 14, and one for safety.
    """
    return (6 if dtype == jnp.float32 else 8) + (2 if size > 8 else 0)


def least_norm_solution(
    A: Float[Array, "n n"], b: Float[Array, " n"], share: float | Array
) -> Float[Array, " n"]:
    """The least x that solves A x = b as well as it goes, for any A.

    Args:
        A: `(n, n)`, n up to seven.
        b: `(n,)`.
        share: singular values up to this share of the largest count as zero.
    """
    n = b.shape[0]
    # Eigenvectors of [[0, A], [A^T, 0]] are pairs of singular vectors: no square of A
    # that would cost half of the digits.
    both = jnp.zeros((2 * n, 2 * n), A.dtype).at[:n, n:].set(A).at[n:, :n].set(A.T)
    value, vector = eigh(both)
    held = jnp.abs(value) > share * jnp.max(jnp.abs(value))
    along = jnp.sum(vector[:n] * b[:, None], axis=0)
    along = jnp.where(held, along / jnp.where(held, value, 1), 0)
    return jnp.sum(vector[n:] * along[None], axis=1)


@jax.custom_jvp
def eigh(
    A: Float[Array, "*b n n"],
) -> tuple[Float[Array, "*b n"], Float[Array, "*b n n"]]:
    """Eigenvalues, ascending, and eigenvectors, in columns, of symmetric matrices.

    By Jacobi's rotations, n / 2 disjoint ones at a time in the order of a tournament;
    for n up to about fourteen.

    Gradients: exact where eigenvalues differ; the free turn of eigenvectors that share
    one is cut. Functions of the whole matrix do not depend on it.
    """
    n = A.shape[-1]
    size = n + n % 2
    largest = jnp.max(jnp.abs(A), axis=(-2, -1), keepdims=True)
    unit = jnp.where(largest > 0, largest, 1)
    A = _padded(A / unit, size)
    V = jnp.broadcast_to(jnp.eye(size, dtype=A.dtype), A.shape)
    rounds = num_sweeps(A.dtype, size) * (size - 1)
    # Those of as many rounds as end where the tournament began.
    A, V = control.fori_loop(0, rounds, lambda _, state: _turned(*state), (A, V))
    value = jnp.diagonal(A, axis1=-2, axis2=-1)[..., :n] * unit[..., 0]
    order = jnp.argsort(value, axis=-1)
    vector = jnp.take_along_axis(V[..., :n, :n], order[..., None, :], axis=-1)
    return jnp.take_along_axis(value, order, axis=-1), vector


@eigh.defjvp
def _eigh_jvp(primals: tuple[Array], tangents: tuple[Array]) -> tuple:
    (A,), (dA,) = primals, tangents
    value, vector = eigh(A)
    across = jnp.swapaxes(vector, -1, -2) @ (dA + jnp.swapaxes(dA, -1, -2)) @ vector / 2
    gap = value[..., None, :] - value[..., :, None]
    top = jnp.max(jnp.abs(value), axis=-1)[..., None, None]
    apart = jnp.abs(gap) > value.shape[-1] * jnp.finfo(value.dtype).eps * top
    turn = jnp.where(apart, across / jnp.where(apart, gap, 1), 0)
    return (value, vector), (
        jnp.diagonal(across, axis1=-2, axis2=-1),
        vector @ turn,
    )


def _turned(A: Array, V: Array) -> tuple[Array, Array]:
    """One round: entries (0, 1), (2, 3), ... are turned to zero, then all move on."""
    first, second = A[..., ::2, ::2], A[..., 1::2, 1::2]
    p, q = (jnp.diagonal(x, axis1=-2, axis2=-1) for x in (first, second))
    c, s = jacobi_rotation(p, q, jnp.diagonal(A[..., ::2, 1::2], axis1=-2, axis2=-1))
    A = _mixed(jnp.swapaxes(_mixed(A, c, s), -1, -2), c, s)
    order = _next_round(A.shape[-1])
    return A[..., order, :][..., order], _mixed(V, c, s)[..., order]


def jacobi_rotation(p: Array, q: Array, off: Array) -> tuple[Array, Array]:
    """Cosine and sine of the smaller turn that makes [[p, off], [off, q]] diagonal."""
    turns = off != 0
    cot = (q - p) / (2 * jnp.where(turns, off, 1))
    sign = jnp.where(cot < 0, -1, 1).astype(off.dtype)
    # The root of t^2 + 2 cot t - 1 of smaller size; cot may be too large to square.
    big = jnp.minimum(jnp.abs(cot), jnp.asarray(1e18, off.dtype))
    t = jnp.where(turns, sign / (big + jnp.sqrt(1 + big * big)), 0)
    c = lax.rsqrt(1 + t * t)
    return c, t * c


def _mixed(X: Array, c: Array, s: Array) -> Array:
    """Columns 2 i and 2 i + 1 of X, turned by c_i and s_i."""
    even, odd = X[..., ::2], X[..., 1::2]
    c, s = c[..., None, :], s[..., None, :]
    both = jnp.stack([c * even - s * odd, s * even + c * odd], axis=-1)
    return both.reshape(X.shape)


def _next_round(n: int) -> list[int]:
    """Where each seat of a tournament of n players takes its next player from.

    Seats 2 i and 2 i + 1 meet. Player 0 stays, the others go round the table.
    """
    table = [*range(2, n, 2), *range(n - 1, 0, -2)]  # the way round, but for seat 0
    come_from = {seat: table[k - 1] for k, seat in enumerate(table)}
    return [0, *(come_from[seat] for seat in range(1, n))]


def _padded(A: Array, size: int) -> Array:
    """With zero rows and columns behind, which no rotation touches."""
    more = size - A.shape[-1]
    pad = [(0, 0)] * (A.ndim - 2) + [(0, more), (0, more)]
    return jnp.pad(A, pad)


def entries(A: Float[Array, "*b n n"]) -> list[list[Float[Array, "*b"]]]:
    """The entries of small matrices, row by row."""
    return [list(jnp.unstack(row, axis=-1)) for row in jnp.unstack(A, axis=-2)]


def _stacked(rows: list[list[Array]]) -> Array:
    return jnp.stack([jnp.stack(row, axis=-1) for row in rows], axis=-2)
