"""`edge_report`: what an adjustment says of each motion, in the terms of surveyors."""

from dataclasses import dataclass
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxreg._core.arrays import widened
from jaxreg._core.checks import check_count
from jaxreg._core.chi_squared import probability_above
from jaxreg._core.programs import kept_program
from jaxreg.averaging.base import AveragingSolution
from jaxreg.averaging.measures import deviations
from jaxreg.averaging.steps.gauss_newton import normal_equations, precisions
from jaxreg.averaging.world.adjusted import Told, as_adjusted
from jaxreg.geometry import lie
from jaxreg.graph.pose_graph import PoseGraph


@dataclass(frozen=True, repr=False)
class EdgeReport:
    """Residuals of an adjustment. NumPy arrays, float64.

    Attributes:
        edges: `(e, 2)` frames i and j; of priors, control points and levels, which
            follow the edges of the graph, i is -1, the world.
        trusted: `(e,)` whether an edge is part of the adjustment.
        rotation: `(e,)` size of the residual, radians.
        translation: `(e,)` size of the residual, unit of the graph.
        normalised: `(e,)` root mean square of the residual's components in a-priori
            standard deviations, sqrt(r' Omega r / k), with k the rank of Omega; also of
            edges not trusted.
        redundancy: `(e,)` the redundancy number, mean over the k components: the share
            of an error in the motion that shows in its residual. 0 where nothing checks
            an edge, near 1 where others fix both its frames. 1 for edges not trusted;
            NaN where the graph is too large, or its equations have no solution. All
            times k sum to `degrees_of_freedom`.
        chi_square: sum of r' Omega r over the trusted edges.
        degrees_of_freedom: components of trusted motions less those of free poses.
        variance_factor: chi_square over degrees_of_freedom, the a-posteriori variance
            of unit weight: 1 where the information is that of the noise; NaN without
            redundancy.
        p_value: probability of so large a chi_square if it is.
        prior_noise: whether the graph has information; without, standard deviations
            are those that the residuals show, and chi_square tests nothing.
        worst: rows of the ten trusted edges of largest `normalised`, largest first.
    """

    edges: np.ndarray
    trusted: np.ndarray
    rotation: np.ndarray
    translation: np.ndarray
    normalised: np.ndarray
    redundancy: np.ndarray
    chi_square: float
    degrees_of_freedom: int
    variance_factor: float
    p_value: float
    prior_noise: bool
    worst: np.ndarray

    def __repr__(self) -> str:
        return (
            f"EdgeReport({int(self.trusted.sum())} of {len(self.edges)} edges, "
            f"chi-square {self.chi_square:.6g} of {self.degrees_of_freedom} degrees of "
            f"freedom,\n    variance factor {self.variance_factor:.4g})"
        )


def edge_report(
    graph: PoseGraph,
    solution: AveragingSolution,
    *,
    min_trust: float = 0.5,
    max_unknowns: int = 6000,
    priors: Told = None,
    fixed: Told = None,
    control: Told = None,
    levels: Told = None,
) -> EdgeReport:
    """Residuals, chi-square and redundancy numbers of averaged poses.

        >>> import jaxreg as jr
        >>> east = [[1, 0, 1], [0, 1, 0], [0, 0, 1]]
        >>> far = [[1, 0, 2.3], [0, 1, 0], [0, 0, 1]]
        >>> edges, nine = [(0, 1), (1, 2), (0, 2)], [[9, 0, 0], [0, 9, 0], [0, 0, 9]]
        >>> T, known = [east, east, far], [nine, nine, nine]
        >>> graph = jr.PoseGraph.from_edges(edges, T, information=known)
        >>> report = jr.edge_report(graph, jr.average(graph, jr.PoseGraphLM()))
        >>> report.degrees_of_freedom, round(report.chi_square, 3)
        (3, 0.27)

    Residuals are log(inv(T_i_j) inv(T_world_i) T_world_j), that of g2o and GTSAM; Omega
    is prior weight times information. Runs on the host.

    Args:
        graph: that was averaged.
        solution: its solution, by any method.
        min_trust: edges whose `edge_weight` is above it are trusted.
        max_unknowns: k per frame, at most, for redundancy numbers, which come from a
            dense inverse in float64.
        priors: those that `average` was given; they are rows after the edges.
        fixed: likewise; fixed frames are no unknowns.
        control: likewise; rows after the priors, of d components.
        levels: likewise; rows after the control points, of two components.

    Raises:
        TypeError: for anything but a graph and a solution.
        ValueError: for a solution of another graph.

    Gradients: none.

    Reference: Baarda 1968; Foerstner 1987 (redundancy numbers).
    """
    prior_noise, own = graph.information is not None, np.asarray(graph.edges)
    graph, solution, first = as_adjusted(
        graph, solution, priors, fixed, control, levels
    )
    check_count(max_unknowns, "max_unknowns")
    with jax.enable_x64(True):
        wide, T = widened((graph, solution.T_world_i))
        given = np.asarray(solution.edge_weight) > min_trust
        finite = np.isfinite(np.asarray(wide.T_i_j)).all(axis=(1, 2))
        sound: np.ndarray = np.asarray(finite)
        usable = np.asarray(graph.mask) & (np.asarray(graph.weight) > 0) & sound
        trusted = given & usable
        held = np.unique(np.append(np.asarray(graph.edges)[trusted], 0))
        few = graph.num_poses * lie.tangent_dim(graph.dim) <= max_unknowns
        at = jax.tree.map(
            np.asarray, _linearised(wide, T, jax.device_put(trusted), few)
        )
    r, weights = np.where(sound[:, None], at.residual, np.nan), at.information
    eps = float(jnp.finfo(graph.T_i_j.dtype).eps)
    k, ranks = r.shape[1], _ranks(weights, graph.dim, eps)
    redundancy = np.full(len(r), np.nan)
    if at.normal is not None:
        redundancy = np.where(trusted, _redundancy(at, graph, ranks, held), 1.0)
    square = np.einsum("ea,eab,eb->e", r, weights, r)
    spare = int(ranks[trusted].sum()) - k * (len(held) - 1)
    total = float(square[trusted].sum())
    normalised = np.sqrt(square / np.maximum(ranks, 1))
    order = np.argsort(-np.where(trusted, normalised, -1), kind="stable")
    d = graph.dim
    return EdgeReport(
        edges=np.concatenate([own, np.asarray(graph.edges)[len(own) :] - first]),
        trusted=trusted,
        rotation=np.linalg.norm(r[:, d:], axis=1),
        translation=np.linalg.norm(r[:, :d], axis=1),
        normalised=normalised,
        redundancy=redundancy,
        chi_square=total,
        degrees_of_freedom=spare,
        variance_factor=total / spare if spare > 0 else float("nan"),
        p_value=probability_above(total, spare) if spare > 0 else float("nan"),
        prior_noise=prior_noise,
        worst=order[: min(10, int(trusted.sum()))],
    )


def _ranks(Omega: np.ndarray, d: int, eps: float) -> np.ndarray:
    """`(e,)` components of which an information says something, beyond rounding.

    Lengths and angles in units in which they weigh alike.
    """
    W = np.where(np.isfinite(Omega), Omega, 0)
    each = np.einsum("eaa->ea", W)
    shift, turn = (each[:, part].mean(1) for part in (slice(d), slice(d, None)))
    unit = np.repeat(np.stack([shift, turn], 1), [d, W.shape[1] - d], axis=1)
    unit = np.sqrt(np.where(unit > 0, unit, 1))
    sizes = np.linalg.eigvalsh(W / unit[:, :, None] / unit[:, None])
    return np.sum(sizes > 10 * eps * sizes[:, -1:], axis=1)


class _Linearised(NamedTuple):
    """The adjustment at its poses, arrays of float64."""

    residual: Any  # (e, k)
    information: Any  # (e, k, k) of each edge
    trusted: Any  # (e, k, k) of those that are trusted, else 0
    by_first: Any  # (e, k, k) the error of an edge by the tangent of its first frame
    normal: Any  # (v k, v k), None of many frames


@kept_program
def _linearised(
    graph: PoseGraph, T: jax.Array, trusted: jax.Array, few: bool
) -> _Linearised:
    share = trusted.astype(T.dtype)
    noise = deviations(graph, T, share)
    Omega = precisions(graph, jnp.ones_like(share), noise)
    if graph.information is None:
        Omega = Omega / noise[1] ** 2
    W = jnp.where(trusted[:, None, None], Omega, 0)
    J = -lie.adjoint(lie.inverse(graph.predicted(T)))
    H = normal_equations(graph, T, W)[0] if few else None
    return _Linearised(graph.tangent_errors(T), Omega, W, J, H)


def _redundancy(
    at: _Linearised, graph: PoseGraph, ranks: np.ndarray, held: np.ndarray
) -> np.ndarray:
    """`(e,)` 1 less the mean of W A inv(A' W A) A' over each edge's components A.

    `held` are the frames that trusted edges hold, and the others no unknowns.
    """
    num, k = graph.num_poses, at.residual.shape[-1]
    H = np.array(at.normal)
    idle = np.setdiff1d(np.arange(num), held)[:, None] * k + np.arange(k)
    H[idle, idle] = 1
    try:
        C = np.linalg.inv(H).reshape(num, k, num, k).swapaxes(1, 2)
    except np.linalg.LinAlgError:  # numbers too large, or too unlike
        return np.full(len(graph.edges), np.nan)
    C[0], C[:, 0] = 0, 0
    i, j = np.asarray(graph.edges).T
    J = at.by_first
    Jt = J.swapaxes(1, 2)
    cross = J @ C[i, j]
    covariance = J @ C[i, i] @ Jt + cross + cross.swapaxes(1, 2) + C[j, j]
    explained = np.einsum("eab,eba->e", at.trusted, covariance)
    return 1 - explained / np.maximum(ranks, 1)
