"""What is wrong with a call is said in one message, before anything is computed.

Thousands of others, also those that types would find: `python -m tests.fuzz`.
"""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxreg as jr
from jaxreg import io, metrics, particle
from jaxreg.testing import problems


CLOUD = np.ones((5, 3), np.float32)
POSES = problems.poses(3).astype(np.float32)
MOTIONS = problems.relative_motions(3, 0.0)[:-1].astype(np.float32)
GRAPH = jr.PoseGraph.from_edges(problems.EDGES[:-1], MOTIONS)
TWO_KEYS = jax.random.split(jax.random.key(0))
TWO_GRAPHS = jax.tree.map(lambda x: jnp.stack([x, x]), GRAPH)
FOUR_GRAPHS = jax.tree.map(lambda x: jnp.stack([x, x]), TWO_GRAPHS)
CALLS: list[tuple[Callable[..., Any], dict[str, Any], str]] = [
    (jr.register, {"source": CLOUD.astype("M8[s]")}, "source: wanted numbers"),
    (jr.register, {"source": iter(CLOUD)}, "source: .*numbers"),
    (jr.register, {"source": CLOUD.astype(np.longdouble)}, "source: wanted float32"),
    (jr.register, {"source_mask": [[True], []]}, "source_mask: not a rectangular"),
    (jr.register, {"key": TWO_KEYS}, "key: wanted one key"),
    (jr.register, {"batch_size": 2**40}, "batch_size: wanted an integer below 2"),
    (jr.average, {"graph": FOUR_GRAPHS}, r"graph: .*leading axes \(2, 2\)"),
    (jr.average, {"init": 2 * POSES}, "init: wanted rigid motions"),
    (jr.average, {"init": 1e30 * POSES}, "init: wanted rigid motions"),
    (metrics.rotation_error, {"T_true_i": POSES[1:]}, "T_true_i: wanted shape"),
    (metrics.align_poses, {"mask": [1, 0, 1, 1, 1]}, "mask: wanted a boolean"),
    (metrics.chordal_objective, {"T_world_i": POSES[1:]}, "T_world_i: wanted shape"),
    (jr.ICP, {"width_end": TWO_KEYS}, "ICP: width_end: wanted"),
    (jr.ICP, {"max_steps": 10**30}, "ICP: max_steps: wanted an integer below"),
    (particle.PartialPose, {"up": "z"}, "PartialPose: up: wanted numbers"),
    (io.write_ply, {"points": CLOUD > 0}, "points: wanted real numbers"),
    (io.write_ply, {"colors": 300 * np.ones((5, 3), int)}, "colors: wanted numbers"),
    (io.write_tum, {"timestamps": [0, 1, np.nan, 3, 4]}, "timestamps: wanted finite"),
    (io.write_tum, {"T_world_i": 0 * POSES}, "T_world_i: wanted rigid"),
    (io.write_kitti, {"T_world_i": 2 * POSES}, "T_world_i: wanted rigid"),
    (io.write_g2o, {"ids": [0, 1, 1, 2, 3]}, "ids: wanted integers, each another"),
    (io.write_log, {"graph": TWO_GRAPHS}, "graph: wanted one graph"),
]
GOOD: dict[Any, dict[str, Any]] = {
    jr.register: {"source": CLOUD, "target": CLOUD, "method": jr.ICP()},
    jr.average: {"graph": GRAPH},
    metrics.rotation_error: {"T_world_i": POSES},
    metrics.align_poses: {"T_world_i": POSES, "T_true_i": POSES},
    metrics.chordal_objective: {"graph": GRAPH},
    jr.PoseGraph.from_edges: {"edges": GRAPH.edges, "T_i_j": MOTIONS},
    io.write_ply: {"points": CLOUD},
    io.write_tum: {"T_world_i": POSES},
    io.write_g2o: {"graph": GRAPH},
}
WRITERS = {io.write_ply, io.write_tum, io.write_kitti, io.write_g2o, io.write_log}


@pytest.mark.parametrize(("function", "wrong", "message"), CALLS)
def test_it_names_the_argument(
    function: Callable[..., Any], wrong: dict[str, Any], message: str, tmp_path: Path
):
    arguments = {**GOOD.get(function, {}), **wrong}
    if function in WRITERS:
        arguments["path"] = tmp_path / "a"
    with pytest.raises((ValueError, TypeError), match=message) as caught:
        function(**arguments)
    assert len(str(caught.value).splitlines()) == 1
    assert list(tmp_path.iterdir()) == []


def test_of_a_method_with_several_numbers_vmap_makes_one_each():
    method = jr.ICP(width_end=jnp.array([1.0, 2.0]))
    with pytest.raises(ValueError, match="ICP: width_end: wanted one number"):
        jr.register(CLOUD, CLOUD, method)
