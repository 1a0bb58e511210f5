"""Many small graphs in one call, and single graphs of 10,000 and 100,000 poses.

Run: python -m bench.averaging_scale batch [--graphs 1000] [--vmap]
     (XLA_FLAGS=--xla_force_host_platform_device_count=2 for two cores)
     python -m bench.averaging_scale large [--poses 10000] [--outliers 0] [--single]

batch  graphs of 32 poses and 465 edges, inlier noise 0.5 degrees and 0.5 % of the size,
       30 % of the motions uniformly random; `average` of all in one call, by `lax.map`
       one after the other, on each device its share, or, with --vmap, side by side
       (where a graph that needs a longer search keeps all others busy).
large  a path in rings of 100 poses: each pose measured from the next and from three on
       the next ring (3.85 edges a pose), noise 1 degree and 0.02 of the distance of
       poses; a share of the edges, all of them closures, joins random poses instead by
       the motion of a true closure. From the motions alone.

Columns: wall and CPU time of a call after the first, wall time of the first, and mean
and largest errors in the best common frame (lengths over the distance between poses);
for batches the share of graphs within 5 degrees and 5 %. The highest memory of the
process is that of the system. Cores: those the process may use (taskset).
"""

import argparse
import resource
from collections.abc import Callable
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np

from bench.timing import cpu_model, num_cores, timed, versions
from bench.workloads.averaging_data import H, N, large_graph, small_graph
from jaxreg import Status
from jaxreg.averaging import AveragingSolution, Correntropy, PoseGraphLM, average
from jaxreg.graph import PoseGraph
from jaxreg.metrics import rotation_errors, translation_errors


def memory() -> float:
    """The highest memory of the process, GB."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6


def in_turn() -> Callable[[PoseGraph], AveragingSolution]:
    """`average` of one graph after the other, on each device of its own share."""
    each = partial(jax.lax.map, average)
    over = jax.sharding.PartitionSpec("graph")
    kind = (jax.sharding.AxisType.Auto,)
    mesh = jax.make_mesh((jax.device_count(),), ("graph",), axis_types=kind)
    return jax.jit(
        jax.shard_map(each, mesh=mesh, in_specs=over, out_specs=over, check_vma=False)
    )


def batch(num: int, side_by_side: bool, seed: int) -> None:
    """Prints the rate of one call on many graphs."""
    rng = np.random.default_rng(seed)
    drawn = [small_graph(rng) for _ in range(num)]
    X, edges, T = (np.stack(x) for x in zip(*drawn, strict=True))
    graphs = PoseGraph(
        edges=jnp.asarray(edges, jnp.int32),
        T_i_j=jnp.asarray(T, jnp.float32),
        weight=jnp.ones((num, H), jnp.float32),
        mask=jnp.ones((num, H), bool),
        information=None,
        num_poses=N,
    )
    many = jax.jit(jax.vmap(average)) if side_by_side else in_turn()
    first = timed(lambda: jax.block_until_ready(many(graphs))).wall
    solution, cpu, seconds = timed(lambda: jax.block_until_ready(many(graphs)))
    found, true = solution.T_world_i, jnp.asarray(X, jnp.float32)
    e_R = jax.vmap(lambda a, b: jnp.mean(rotation_errors(a, b, "best")))(found, true)
    e_t = jax.vmap(lambda a, b: jnp.mean(translation_errors(a, b, "best")))(found, true)
    right = np.mean((np.rad2deg(e_R) < 5) & (np.asarray(e_t) < 0.05))
    print(
        f"{num} graphs of {N}:{H}: {num / seconds:.0f} graphs/s, call {seconds:.2f} s "
        f"(CPU {cpu:.2f}), first {first:.1f} s, right {right:.3f}, "
        f"memory {memory():.2f} GB"
    )


def large(num: int, outliers: float, single: bool, seed: int) -> None:
    """Prints the time and errors on one large graph."""
    X, edges, T, wrong = large_graph(num, outliers, seed)
    dtype = np.float32 if single else np.float64
    d = np.deg2rad(1.0)
    information = np.diag(np.repeat([1 / 0.02**2, 1 / d**2], 3))
    information = np.broadcast_to(information, (len(edges), 6, 6)).astype(dtype)
    graph = PoseGraph.from_edges(edges, T.astype(dtype), num, None, information)
    print(f"{graph}, {int(wrong.sum())} of them wrong")
    methods = {"PoseGraphLM": PoseGraphLM()} if outliers == 0 else {}
    for name, method in {**methods, "Correntropy": Correntropy()}.items():

        def call(method=method):
            return jax.block_until_ready(average(graph, method))

        first = timed(call).wall
        solution, cpu, seconds = timed(call)
        found, true = solution.T_world_i, jnp.asarray(X, dtype)
        e_R = np.rad2deg(rotation_errors(found, true, "best"))
        e_t = np.asarray(translation_errors(found, true, "best"))
        trusted = np.asarray(solution.edge_weight) > 0.5
        print(
            f"{name:12} {seconds:7.2f} s (CPU {cpu:.2f}), first {first:6.1f} s, "
            f"{Status(int(solution.status)).name}, {int(solution.num_steps)} steps, "
            f"rotation {e_R.mean():.3f} (largest {e_R.max():.2f}) degrees, "
            f"position {e_t.mean():.4f} ({e_t.max():.3f}), wrong edges trusted "
            f"{int((trusted & wrong).sum())}, right ones not "
            f"{int((~trusted & ~wrong).sum())}, memory {memory():.2f} GB",
            flush=True,
        )


def main() -> None:
    """Runs one of the two parts."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("part", choices=["batch", "large"])
    parser.add_argument("--graphs", type=int, default=1000)
    parser.add_argument("--vmap", action="store_true")
    parser.add_argument("--poses", type=int, default=10_000)
    parser.add_argument("--outliers", type=float, default=0.0)
    parser.add_argument("--single", action="store_true", help="float32")
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    print(f"{cpu_model()}, {num_cores()} cores, {versions('jax', 'jaxlib')}")
    if options.part == "batch":
        batch(options.graphs, options.vmap, options.seed)
        return
    jax.config.update("jax_enable_x64", not options.single)
    large(options.poses, options.outliers, options.single, options.seed)


if __name__ == "__main__":
    main()
