"""Makes the pictures of the pages on concepts: `python docs/pictures.py`."""

from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import matplotlib
import numpy as np
from matplotlib import pyplot as plt

import jaxreg as jr
from jaxreg.datasets import word_points


FOLDER = Path(__file__).parent / "pages" / "pictures"
BLUE, ORANGE, GREY = "#2160ac", "#d9622b", "0.72"


def motion(angle: float, x: float, y: float) -> np.ndarray:
    """A motion of the plane."""
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, -s, x], [s, c, y], [0, 0, 1]])


def draw_filter() -> None:
    """The particles of a search, from the first draws to the modes."""
    target = word_points("STAR", spacing=2.0).astype(np.float32)
    T = motion(np.deg2rad(200), 90, -60)
    source = word_points("R", spacing=2.0) @ T[:2, :2].T + T[:2, 2]
    source = source.astype(np.float32)
    # Without stopping early, and with few particles, so that there is much to see.
    method = jr.ParticleFilter(num_prior=256, num_particles=48, num_agreeing=0)
    key = jax.random.key(1)
    filtering = method.iteration(source, target, key=key)
    leave, step = filtering.problem.frames.leave, eqx.filter_jit(filtering.step)
    drawn = method.starts(key, 48, filtering.problem, None)
    state = filtering.init(key)
    stages = [("1: drawn from everywhere", leave(drawn), np.ones(12))]
    for t in range(1, method.num_times + 1):
        poses, weight = leave(state.T_target_source), np.exp(state.log_weight)
        if t == 1:
            stages.append(("2: each after some steps downhill", poses, weight))
        if t == 3:
            stages.append(("3: the better ones, moved and improved", poses, weight))
        if filtering.terminate(state):
            break
        state, _ = step(jax.random.fold_in(key, t), state)
    weight = np.exp(state.log_weight)
    stages.append(("4: what is left", leave(state.T_target_source), weight))
    figure, axes = plt.subplots(2, 2, figsize=(10, 5), layout="constrained")
    for axis, (title, poses, weight) in zip(axes.flat, stages, strict=True):
        axis.scatter(*target.T, s=3, color=GREY)
        for row in np.argsort(-weight, kind="stable")[:48]:
            T = np.asarray(poses)[row]
            share = float(weight[row] / weight.max())
            placed = source @ T[:2, :2].T + T[:2, 2]
            axis.scatter(*placed.T, s=1, color=BLUE, alpha=0.06 + 0.5 * share)
        middle, reach = target.mean(axis=0), np.ptp(target, axis=0).max()
        axis.set(xlim=middle[0] + np.array([-0.7, 0.7]) * reach)
        axis.set(ylim=middle[1] + np.array([-0.32, 0.32]) * reach, title=title)
        axis.set_aspect("equal")
        axis.set_axis_off()
    save(figure, "filter.png")


def ring(num: int, num_wrong: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Edges of poses on a circle, their motions, and which are wrong."""
    rng = np.random.default_rng(4)
    around = 2 * np.pi * np.arange(num) / num
    T = np.stack([motion(a + np.pi / 2, 5 * np.cos(a), 5 * np.sin(a)) for a in around])
    gaps = (1, 2, 5)
    edges = np.array([(k, (k + gap) % num) for gap in gaps for k in range(num)])
    i, j = edges.T
    noise = [motion(*row) for row in rng.normal(size=(len(edges), 3)) * 0.03]
    T_i_j = np.linalg.inv(T[i]) @ T[j] @ np.stack(noise)
    wrong = rng.permutation(len(edges))[:num_wrong]
    T_i_j[wrong] = [motion(*row) for row in rng.normal(size=(num_wrong, 3)) * 3]
    return edges, T_i_j, np.isin(np.arange(len(edges)), wrong)


def draw_trust() -> None:
    """Poses before and after averaging, and the trust in each motion."""
    edges, T_i_j, wrong = ring(20, 18)
    graph = jr.PoseGraph.from_edges(edges, T_i_j.astype(np.float32))
    before = jr.average(graph, jr.SpanningTree())
    after = jr.average(graph)
    trust = np.asarray(after.edge_weight)
    figure, axes = plt.subplots(1, 3, figsize=(11, 3.6), layout="constrained")
    titles = "along a spanning tree", "averaged: what agrees is trusted"
    for axis, sol, title in zip(axes, (before, after), titles, strict=False):
        draw_graph(axis, np.asarray(sol.T_world_i), edges, trust)
        axis.set_title(title)
    T = np.asarray(after.T_world_i)
    left = np.linalg.inv(T[edges[:, 0]]) @ T[edges[:, 1]]
    off = np.linalg.norm((left - T_i_j)[:, :2, 2], axis=1)
    for kind, color, name in ((~wrong, BLUE, "right"), (wrong, ORANGE, "wrong")):
        axes[2].scatter(off[kind], trust[kind], s=14, color=color, label=name)
    axes[2].set(xscale="log", xlabel="how far a motion is off", ylabel="trust")
    axes[2].axhline(0.5, color=GREY, lw=1)
    axes[2].legend(frameon=False)
    save(figure, "trust.png")


def draw_graph(axis: Any, T: np.ndarray, edges: np.ndarray, trust: np.ndarray) -> None:
    """Positions, and a line for each motion in the colour of its trust."""
    position = T[:, :2, 2]
    for (i, j), share in sorted(zip(edges.tolist(), trust, strict=True), key=str):
        good = share > 0.5
        style = {"color": BLUE if good else ORANGE, "ls": "-" if good else ":"}
        axis.plot(*position[[i, j]].T, lw=1.2 if good else 0.8, **style)
    axis.scatter(*position.T, s=16, color="black", zorder=3)
    axis.set_aspect("equal")
    axis.set_axis_off()


def save(figure: Any, name: str) -> None:
    """Writes a picture, without what changes from run to run."""
    figure.savefig(FOLDER / name, dpi=110, metadata={"Software": None})
    plt.close(figure)


if __name__ == "__main__":
    matplotlib.use("agg")
    draw_filter()
    draw_trust()
