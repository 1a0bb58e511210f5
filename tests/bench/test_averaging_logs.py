"""The workload of real motions takes all of its files, as far off SO(3) as they are."""

import jax.numpy as jnp
import pytest
from helpers import data_dir

from bench.case import Options
from bench.workloads.averaging_logs import cases


@pytest.mark.data
def test_every_scene_and_log_is_a_trial():
    data_dir("learning2sync_relative_poses")
    root = data_dir("redwood_3dmatch_relative_poses").parent
    scenes, logs = cases(Options(quick=False, data=root))
    assert (len(scenes.trials), len(logs.trials)) == (33, 20)
    for (graph,) in logs.trials:
        R = graph.T_i_j[:, :3, :3]
        off = jnp.swapaxes(R, 1, 2) @ R - jnp.eye(3)
        assert jnp.max(jnp.abs(off)) < 1e-5
