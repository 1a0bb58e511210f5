"""`certify`: how far poses are from the global minimum of SE-Sync's objective.

The dual problem: for symmetric multipliers Lambda_i such that S = M - diag(Lambda_i, 0)
is positive semidefinite, every set of poses has F >= sum of tr(Lambda_i). At the global
minimum, and noise that is not extreme, the multipliers of the minimum itself do that,
and the bound is the minimum. Where the least eigenvalue of S is -m, Lambda_i - m I do.

The least eigenvalue counts rotations alone (translations are eliminated), which the
multipliers are about. See `relaxation.certificate_matrix`.

Reference: Rosen, Carlone, Bandeira, Leonard, SE-Sync, IJRR 2019.
"""

from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np

from jaxreg._core.arrays import widened
from jaxreg._core.checks import as_host_numbers, is_concrete, shown
from jaxreg._core.status import Status
from jaxreg.averaging.base import AveragingSolution
from jaxreg.averaging.relaxation.certificate_matrix import CertificateMatrix
from jaxreg.averaging.relaxation.connection import (
    Connection,
    joined,
    lifted,
    rigid,
)
from jaxreg.averaging.world.adjusted import check_solution
from jaxreg.graph.chordal import chordal_weights
from jaxreg.graph.pose_graph import PoseGraph


# Of the certified gap, what the shift of the eigenvalues may cost.
_SHIFT_SHARE = 0.25


@dataclass(frozen=True, repr=False)
class Certificate:
    """What is known of poses beside all others. NumPy arrays, float64.

    Attributes:
        status: CONVERGED where the poses are certified; UNCERTIFIED where not;
            DISCONNECTED where trusted edges do not hold all poses that are placed: the
            numbers then speak of the frames that are `covered`; NON_FINITE where poses
            or trusted edges are not finite, or their squares.
        certified: whether the gap is at most `tolerance` of the objective, or what
            rounding to the dtype of the poses makes.
        objective: SE-Sync's objective F of the poses, over the trusted edges.
        lower_bound: no poses whatever have a smaller F; at least 0.
        gap: `objective - lower_bound`.
        minimum: F of the local minimum near the poses, whose multipliers are used.
        least_eigenvalue: of the certificate matrix there, translations eliminated; 0
            but for rounding at a certified minimum. Unit of kappa.
        eigenvector: `(v, d+1)`, the direction of negative curvature where the least
            eigenvalue is negative: how a further row of all [R_i t_i] would change; of
            unit length in the rotations' columns. 0 for frames not covered.
        covered: `(v,)` the frames that trusted edges join to frame 0.
        num_edges: how many edges are trusted.
    """

    status: Status
    certified: bool
    objective: float
    lower_bound: float
    gap: float
    minimum: float
    least_eigenvalue: float
    eigenvector: np.ndarray
    covered: np.ndarray
    num_edges: int

    def __repr__(self) -> str:
        told = "certified" if self.certified else "not certified"
        return (
            f"Certificate({told}: objective {self.objective:.8g}, no poses below "
            f"{self.lower_bound:.8g},\n    {int(self.covered.sum())} of "
            f"{len(self.covered)} poses, {self.num_edges} edges, {self.status.name})"
        )


def certify(
    graph: PoseGraph,
    solution: AveragingSolution,
    *,
    min_trust: float = 0.5,
    tolerance: float = 1e-6,
) -> Certificate:
    """Whether poses are the best there are: a lower bound of SE-Sync's objective.

        >>> import jaxreg as jr
        >>> east = [[1, 0, 1], [0, 1, 0], [0, 0, 1]]
        >>> far = [[1, 0, 2.3], [0, 1, 0], [0, 0, 1]]
        >>> graph = jr.PoseGraph.from_edges([(0, 1), (1, 2), (0, 2)], [east, east, far])
        >>> sol = jr.average(graph, jr.PoseGraphLM(jr.ChordalError()))
        >>> found = jr.certify(graph, sol)
        >>> found.certified, round(found.lower_bound, 4)
        (True, 0.03)

    The objective is `jaxreg.metrics.chordal_objective` over the trusted edges, with the
    kappa and tau of `PoseGraphLM(ChordalError())`. The bound holds for all poses,
    whatever method found these, and whether they are a minimum of it or not: poses of
    another objective, such as that of `LogError()`, keep a gap which says how much they
    give away. It says nothing of edges that are not trusted: that these are the wrong
    ones is not certified.

    Runs on the host in float64, without jit, also where JAX computes in float32; poses
    in float32 are certified up to that rounding.

    Args:
        graph: that was averaged.
        solution: its solution, by any method.
        min_trust: edges whose `edge_weight` is above it are trusted, each with its full
            prior weight.
        tolerance: the largest gap of certified poses, as a share of the objective.

    Returns:
        A `Certificate`. Not certified are local minima, poses that are no minimum, and
        minima of graphs so noisy that the bound is below them.

    Raises:
        TypeError: for anything but a graph and a solution, or while tracing.
        ValueError: for a solution of another graph, or numbers out of range.

    Gradients: none.

    Reference: Rosen, Carlone, Bandeira, Leonard, SE-Sync, IJRR 2019.
    """
    trusted, T = _checked(graph, solution, min_trust, tolerance)
    with jax.enable_x64(True):
        wide = widened(graph)
        kappa, tau = (np.asarray(x) for x in _weights(wide))
    usable = trusted & np.asarray(graph.mask) & (kappa > 0) & (tau > 0)
    motions = np.asarray(graph.T_i_j, np.float64)
    sound: np.ndarray = np.isfinite(kappa + tau)
    # Also the squares, of which the matrices are made.
    sound = sound & np.isfinite((kappa + tau) * _squares(motions))
    sound_poses: np.ndarray = np.asarray(np.isfinite(_squares(T)))
    T = rigid(np.where(sound_poses[:, None, None], T, np.eye(T.shape[-1])))
    edges, keep = np.asarray(graph.edges), np.asarray(usable & sound)
    covered = joined(edges[keep], graph.num_poses)
    keep &= covered[edges[:, 0]]
    number = np.cumsum(covered) - 1
    weights = kappa[keep], tau[keep]
    connection = Connection.of(
        number[edges[keep]], motions[keep], weights, int(covered.sum())
    )
    placed = np.asarray(solution.placed)
    status = Status.CONVERGED
    if not np.all(sound[usable]) or not np.all(sound_poses):
        status = Status.NON_FINITE
    elif not np.all(covered):
        status = Status.DISCONNECTED
    rounding = float(jnp.finfo(solution.T_world_i.dtype).eps)
    bound = _bound(connection, T[covered], tolerance, rounding)
    return _concluded(bound, status, covered, bool(np.all(covered | ~placed)))


@dataclass(frozen=True)
class _Bound:
    objective: float
    lower_bound: float
    minimum: float
    least_eigenvalue: float
    eigenvector: np.ndarray
    num_edges: int
    met: bool


def _bound(
    connection: Connection, T: np.ndarray, tolerance: float, eps: float
) -> _Bound:
    objective = connection.objective(T)
    size = np.sum(T[:, :-1] ** 2, axis=1)[connection.edges].sum(axis=1)
    noise = 16 * eps**2 * float(np.sum(connection.precision * size))
    best, found, gap = T, None, 0.0
    for again in (False, True):
        # Poses of a loose method are a proof only after some steps more.
        best = connection.nearby_minimum(T) if again else T
        matrix = CertificateMatrix.of(connection, lifted(best))
        found = matrix.least(_SHIFT_SHARE * tolerance * connection.objective(best))
        lower = max(matrix.trace - matrix.count * found.above, 0.0)
        gap = objective - lower
        if found.proved and gap <= tolerance * objective + noise:
            break
    return _Bound(
        objective=objective,
        lower_bound=lower,
        minimum=connection.objective(best),
        least_eigenvalue=found.value,
        eigenvector=found.vector,
        num_edges=len(connection.edges),
        met=gap <= tolerance * objective + noise,
    )


def _concluded(
    bound: _Bound, status: Status, covered: np.ndarray, complete: bool
) -> Certificate:
    certified = bound.met and complete and status != Status.NON_FINITE
    if status == Status.CONVERGED and not certified:
        status = Status.UNCERTIFIED
    vector = np.zeros((len(covered), bound.eigenvector.shape[1]))
    vector[covered] = bound.eigenvector
    return Certificate(
        status=status,
        certified=certified,
        objective=bound.objective,
        lower_bound=bound.lower_bound,
        gap=bound.objective - bound.lower_bound,
        minimum=bound.minimum,
        least_eigenvalue=bound.least_eigenvalue,
        eigenvector=vector,
        covered=covered,
        num_edges=bound.num_edges,
    )


_weights = jax.jit(chordal_weights)


def _squares(T: np.ndarray) -> np.ndarray:
    with np.errstate(over="ignore", invalid="ignore"):
        return np.sum(T**2, axis=(1, 2))


def _checked(
    graph: PoseGraph, solution: object, min_trust: float, tolerance: float
) -> tuple[np.ndarray, np.ndarray]:
    """Which edges are trusted, and the poses."""
    if not isinstance(solution, AveragingSolution):
        raise TypeError(
            f"solution: wanted an AveragingSolution, found {shown(solution)}."
        )
    leaves = jax.tree.leaves((graph, solution))
    if any(not is_concrete(x) for x in leaves):
        raise TypeError("certify: works on the host, not inside jit, vmap or grad.")
    check_solution(graph, solution)
    if solution.prior_weight is not None:
        raise ValueError(
            "solution: wanted one of the graph alone, found one with priors, fixed "
            "poses or control points."
        )
    for name, value in (("min_trust", min_trust), ("tolerance", tolerance)):
        found = as_host_numbers(value, name)
        if found.ndim or not 0 <= found < 1:
            raise ValueError(f"{name}: wanted a number in [0, 1), found {value}.")
    trusted = np.asarray(solution.edge_weight) > min_trust
    return trusted, np.asarray(solution.T_world_i, np.float64)
