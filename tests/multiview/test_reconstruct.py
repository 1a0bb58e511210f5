"""`reconstruct` on scans of a generated sculpture."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import blob, compiled, half_noise, motion, move, pose_error

import jaxreg as jr
from jaxreg import Status, particle
from jaxreg.datasets import cube_points
from jaxreg.multiview import RelativeMotions
from jaxreg.multiview.check_scans import padded_scans


pytestmark = pytest.mark.usefixtures("fully_compiled")


FILTER = jr.ParticleFilter(num_prior=1024, num_particles=64)
# Eight scans of about so many points in each list make one program do for all.
NUM, NUM_POINTS = 8, 3100

MOTIONS = RelativeMotions(
    jnp.array([[2, 8]]), jnp.eye(4)[None, None], *(jnp.ones((1, 1)) for _ in range(3))
)


@pytest.fixture(scope="module")
def sculpture(reconstructed):
    return reconstructed.scans, reconstructed.truth


def _errors(sol, truth):
    first = np.linalg.inv(truth[0])
    return [
        pose_error(T, first @ T_true)
        for T, T_true in zip(sol.T_world_i, truth, strict=True)
    ]


@pytest.fixture(scope="module")
def solved(reconstructed):
    return reconstructed.solution, reconstructed.calls, reconstructed.pairs


def test_all_scans_are_placed_without_a_guess(sculpture, solved):
    sol, _, _ = solved
    assert int(sol.status) == Status.CONVERGED
    assert np.all(sol.placed)
    errors = np.array(_errors(sol, sculpture[1]))
    assert errors[:, 0].max() < 0.02
    assert errors[:, 1].max() < 0.004
    np.testing.assert_array_equal(sol.T_world_i[0], np.eye(4))


def test_every_pair_is_reported_with_what_is_known_of_it(sculpture, solved):
    sol, _, _ = solved
    pairs = np.asarray(sol.graph.edges)
    assert 12 <= len(pairs) == len(np.unique(pairs, axis=0)) <= 28
    assert np.all(pairs[:, 0] < pairs[:, 1])
    assert sol.trace is not None
    assert int(sol.trace.num_rows) > 1
    trusted = np.asarray(sol.edge_weight) > 0.5
    assert trusted.sum() >= 7
    for e in np.flatnonzero(trusted):
        i, j = np.asarray(sol.graph.edges[e])
        truth = np.linalg.inv(sculpture[1][i]) @ sculpture[1][j]
        assert pose_error(sol.graph.T_i_j[e], truth)[0] < 0.05
    told = np.asarray(sol.motions.log_evidence)[
        np.arange(len(pairs)), np.asarray(sol.mode)
    ]
    assert np.all(told[trusted] > 0)


def test_a_solution_is_cut_to_any_number_of_pairs_and_scans_without_a_program(solved):
    sol, _, _ = solved
    with compiled() as names:
        some = sol.of_pairs(5).of_scans(6)
    assert names == []
    assert some.T_world_i.shape[0] == some.graph.num_poses == 6
    np.testing.assert_array_equal(some.graph.edges, sol.graph.edges[:5])
    np.testing.assert_array_equal(some.motions.overlap, sol.motions.overlap[:5])


def test_progress_names_stages_and_ends_at_the_total(solved):
    _, calls, _ = solved
    stages = list(dict.fromkeys(stage for stage, _, _ in calls))
    assert stages == [
        "preparing scans",
        "registering pairs",
        "averaging and refining",
    ]
    for stage in stages:
        done = [d for s, d, _ in calls if s == stage]
        total = [t for s, _, t in calls if s == stage]
        assert done == sorted(done)
        assert total == sorted(total)
        assert done[-1] == total[-1]


def test_an_interrupted_run_goes_on_to_the_same_answer(sculpture, solved):
    sol, _, found = solved
    kept, new = RelativeMotions.joined(found[2:]), []
    again = jr.reconstruct(
        sculpture[0],
        key=jax.random.key(0),
        method=FILTER,
        previous=kept,
        on_pairs=new.append,
    )
    assert (
        sum(len(x.overlap) for x in new) == sol.graph.num_edges - len(kept.overlap) > 0
    )
    np.testing.assert_array_equal(again.graph.edges, sol.graph.edges)
    np.testing.assert_allclose(again.T_world_i, sol.T_world_i, atol=1e-5)


@pytest.fixture(scope="module")
def earlier(solved):
    """The solution of the first seven scans."""
    old = np.flatnonzero(np.max(solved[0].graph.edges, axis=1) < 7)
    rows = {solved[0].graph.num_edges: old, 8: np.arange(7)}

    def of_seven(x):
        return x[rows[len(x)]] if x.ndim and len(x) in rows else x

    return jax.tree.map(of_seven, solved[0])


def test_a_new_scan_joins_an_earlier_solution(sculpture, solved, earlier):
    sol, _, _ = solved
    new = []
    again = jr.reconstruct(
        sculpture[0],
        key=jax.random.key(0),
        method=FILTER,
        previous=earlier,
        on_pairs=new.append,
    )
    pairs = np.concatenate([x.pairs for x in new])
    assert len(pairs) >= 2
    np.testing.assert_array_equal(pairs[:, 1], 7)
    np.testing.assert_allclose(again.T_world_i, sol.T_world_i, atol=1e-5)


def test_held_poses_stay_and_a_new_scan_lies_beside_them(sculpture, earlier):
    turned = np.asarray(motion(3, 3), np.float32)
    bent = eqx.tree_at(lambda s: s.T_world_i, earlier, turned @ earlier.T_world_i)
    again = jr.reconstruct(
        sculpture[0],
        key=jax.random.key(0),
        method=FILTER,
        previous=bent,
        hold_previous=True,
    )
    np.testing.assert_array_equal(again.T_world_i[:7], bent.T_world_i)
    assert np.all(again.placed)
    T_true = np.linalg.inv(sculpture[1][0]) @ sculpture[1][7]
    angle, shift = pose_error(again.T_world_i[7], turned @ T_true)
    assert angle < 0.02
    assert shift < 0.004


def test_a_sequence_takes_fewer_pairs(sculpture):
    scans, truth = sculpture
    key = jax.random.key(0)
    sol = jr.reconstruct(scans, key=key, method=FILTER, order="sequential")
    assert np.all(sol.placed)
    assert sol.overlap.shape[0] < 22  # of 28; 18 to 21 by four keys
    assert np.array(_errors(sol, truth))[:, 0].max() < 0.02


def test_a_sequence_goes_on_as_it_moved_before(sculpture):
    scans, truth = sculpture
    # Frames that a scanner would have on an even turn about the sculpture.
    step = motion(5, 3, angle=0.2, shift=0.02)
    poses = np.stack([np.linalg.matrix_power(step, k) for k in range(len(scans))])
    told = np.linalg.inv(poses) @ np.linalg.inv(truth[0]) @ truth
    calls = []
    sol = jr.reconstruct(
        [move(T, points) for T, points in zip(told, scans, strict=True)],
        key=jax.random.key(0),
        method=FILTER,
        order="sequential",
        progress=lambda *call: calls.append(call),
    )
    assert np.array(_errors(sol, poses))[:, 0].max() < 0.02
    # Found without a search: most of the seven steps.
    assert next(done for stage, done, _ in calls if stage == "registering pairs") >= 4


def test_bad_scans_are_reported_and_the_others_placed(sculpture):
    scans, truth = sculpture
    # In place of scan 0: a foreign object. Of scan 1: too few points, and NaN rows.
    # Neighbours on the circle of views, so that the others still hang together.
    strange = [0.2 * blob(NUM_POINTS, 3), *scans[1:]]
    strange[1] = np.full((NUM_POINTS, 3), np.nan, np.float32)
    strange[1][:2] = [[0, 0, 0], [0.1, 0, 0]]
    sol = jr.reconstruct(strange, key=jax.random.key(0), method=FILTER)
    assert int(sol.status) == Status.DISCONNECTED
    assert Status(int(sol.scan_status[0])) == Status.LOW_OVERLAP
    assert Status(int(sol.scan_status[1])) == Status.TOO_FEW_POINTS
    np.testing.assert_array_equal(
        sol.num_dropped, [0, NUM_POINTS - 2, 0, 0, 0, 0, 0, 0]
    )
    placed = np.flatnonzero(sol.placed)
    assert len(placed) >= 4
    # The world is the frame of the first scan that is placed.
    first = placed[0]
    for i in placed:
        T_true = np.linalg.inv(truth[first]) @ truth[i]
        assert pose_error(sol.T_world_i[i], T_true)[0] < 0.03


def test_spheres_are_ambiguous(sculpture):
    rng = np.random.default_rng(0)
    x = rng.standard_normal((NUM, 3000, 3))
    x /= np.linalg.norm(x, axis=2, keepdims=True)
    # Rows that do not count, for the size of the others.
    x = np.pad(x, [(0, 0), (0, NUM_POINTS - 3000), (0, 0)], constant_values=np.nan)
    spheres = list((0.1 * x).astype(np.float32))
    sol = jr.reconstruct(spheres, key=jax.random.key(0), method=FILTER)
    assert int(sol.status) == Status.AMBIGUOUS
    assert np.sum(np.asarray(sol.scan_status) == Status.AMBIGUOUS) >= 7


def test_cubes_are_ambiguous():
    # Each fits the others in 24 poses.
    cubes = []
    for seed in range(NUM):
        points = cube_points(NUM_POINTS, seed, side=0.2).astype(np.float32)
        cubes.append(move(motion(seed, 3), points))
    sol = jr.reconstruct(cubes, key=jax.random.key(0), method=FILTER)
    assert int(sol.status) == Status.AMBIGUOUS
    assert np.sum(np.asarray(sol.scan_status) == Status.AMBIGUOUS) == 7


def test_level_cubes_are_told_apart_by_where_their_scanners_stood():
    # Level ones fit each other in four headings; where each scanner stood tells which.
    rng = np.random.default_rng(0)
    cubes, antennas, places, poses = [], [], [], []
    for seed in range(NUM):
        T = np.eye(4)
        T[:2, :2], T[:3, 3] = motion(seed, 2)[:2, :2], rng.normal(size=3)
        place = rng.normal(scale=0.5, size=3)
        points = cube_points(NUM_POINTS, seed, side=0.2).astype(np.float32)
        cubes.append(move(np.linalg.inv(T), points).astype(np.float32))
        antennas.append(move(np.linalg.inv(T), place[None])[0])
        places.append(place + [4e5, 4.2e6, 100])
        poses.append(T)
    sol = jr.reconstruct(
        cubes,
        key=jax.random.key(0),
        # Compiles quicker than the filter; starts that are level and in place suffice.
        method=jr.MultiStart(64, 16, prior=jr.PartialPose(up=(0, 0, 1))),
        positions=jr.ScanPositions(np.array(places), 0.02, np.array(antennas)),
    )
    assert int(sol.status) == Status.CONVERGED
    assert np.array(_errors(sol, np.array(poses)))[:, 0].max() < 0.01


@pytest.mark.parametrize(
    ("positions", "method", "words"),
    [
        (np.zeros((7, 3)), FILTER, r"wanted shape \(8, 3\), found \(7, 3\)"),
        (np.zeros((8, 3)), jr.ICP(), "wanted a search"),
        (
            np.zeros((8, 3)),
            dataclasses.replace(FILTER, prior=particle.UniformPrior()),
            "found UniformPrior",
        ),
    ],
)
def test_positions_that_cannot_be_used_are_refused(sculpture, positions, method, words):
    with pytest.raises(ValueError, match=words):
        jr.reconstruct(
            sculpture[0],
            key=jax.random.key(0),
            method=method,
            positions=jr.ScanPositions(positions),
        )


def test_identical_scans_lie_on_each_other(sculpture):
    same = [max(sculpture[0], key=len)] * 8
    sol = jr.reconstruct(same, key=jax.random.key(0), method=FILTER)
    assert int(sol.status) == Status.CONVERGED
    for T in sol.T_world_i:
        angle, shift = pose_error(T, np.eye(4))
        assert angle < 1e-3
        assert shift < 1e-4


def test_scans_in_another_unit_are_left_out(sculpture):
    scans, truth = sculpture
    mixed = list(scans)
    mixed[3], mixed[6] = 1000 * scans[3], scans[6] / 1000
    sol = jr.reconstruct(mixed, key=jax.random.key(0), method=FILTER)
    assert int(sol.status) == Status.DISCONNECTED
    for i in (3, 6):
        assert Status(int(sol.scan_status[i])) == Status.UNIT_DIFFERS
        assert not sol.placed[i]
    assert "UNIT_DIFFERS 2" in repr(sol)
    assert np.array(_errors(sol, truth))[np.asarray(sol.placed), 0].max() < 0.02
    assert np.sum(sol.placed) >= 5


def test_of_a_scan_of_many_points_some_are_drawn():
    few, many = np.ones((100, 3), np.float32), np.arange(6e6, dtype=np.float32)
    points, mask = padded_scans([few, many.reshape(-1, 3)], None)
    assert points.shape == (2, 524_288, 3)
    np.testing.assert_array_equal(np.sum(mask, axis=1), [100, 524_288])
    rows = np.asarray(points[1, :, 0]) / 3
    assert np.all(np.diff(rows) > 0)  # rows of the scan, none twice
    assert np.ptp(np.histogram(rows, 10, (0, 2e6))[0]) < 2000


def test_two_objects_make_two_components(sculpture):
    scans, truth = sculpture
    # Views of a second object in place of the last three.
    other = 0.1 * blob(5000, 3)
    mixed, poses = list(scans), truth.copy()
    for i, view in enumerate([[1, 0, 0], [0.8, 0.6, 0], [0.6, 0, 0.8]], start=5):
        poses[i] = motion(i, 3)
        seen = other[other @ np.array(view) > -0.02]
        mixed[i] = move(np.linalg.inv(poses[i]), seen[:2900])
    sol = jr.reconstruct(mixed, key=jax.random.key(0), method=FILTER)
    assert "5 of 8 scans placed, apart from them 3" in repr(sol)
    assert int(sol.status) == Status.DISCONNECTED
    np.testing.assert_array_equal(sol.component, [0] * 5 + [1] * 3)
    np.testing.assert_array_equal(sol.placed, [True] * 5 + [False] * 3)
    np.testing.assert_array_equal(sol.scan_status[5:], [Status.DISCONNECTED] * 3)
    for i in range(8):
        first = 5 if i >= 5 else 0
        T_true = np.linalg.inv(poses[first]) @ poses[i]
        angle, shift = pose_error(sol.T_world_i[i], T_true)
        assert angle < 0.02
        assert shift < 0.004


def test_half_noise_leaves_all_scans_placed(sculpture):
    scans, truth = sculpture
    scans = [half_noise(x, seed) for seed, x in enumerate(scans)]
    sol = jr.reconstruct(scans, key=jax.random.key(0), method=FILTER)
    assert np.all(sol.placed)
    errors = np.array(_errors(sol, truth))
    assert errors[:, 0].max() < 0.02
    assert errors[:, 1].max() < 0.004


def test_floor_plans_in_the_plane():
    rng = np.random.default_rng(0)
    # Walls of a floor plan, each scan sees those within two thirds of its width.
    ends = rng.uniform(0, 1, (14, 2, 2))
    along = rng.uniform(0, 1, (6000, 1))
    wall = rng.integers(0, 14, 6000)
    world = ends[wall, 0] * (1 - along) + ends[wall, 1] * along
    world = (world + 1e-3 * rng.standard_normal(world.shape)).astype(np.float32)
    poses = [motion(s, 2) for s in range(4)]
    corners = [(0.25, 0.25), (0.75, 0.25), (0.75, 0.75), (0.25, 0.75)]
    scans = []
    for T, corner in zip(poses, corners, strict=True):
        seen = np.max(np.abs(world - corner), axis=1) < 0.55
        rows = rng.permutation(np.flatnonzero(seen))[:2000]
        scans.append(move(np.linalg.inv(T), world[rows]))
    sol = jr.reconstruct(scans, key=jax.random.key(0), method=FILTER)
    assert np.all(sol.placed)
    for T, T_true in zip(sol.T_world_i, poses, strict=True):
        assert pose_error(T, np.linalg.inv(poses[0]) @ T_true)[0] < 0.03


@pytest.mark.parametrize(
    ("scans", "words"),
    [
        ([np.ones((5, 3))], "two or more"),
        ([np.ones((5, 3)), np.ones((5, 2))], r"scans\[1\].*\(n, 3\)"),
        (np.ones((5, 3)), "list of two or more"),
        ([np.ones((5, 3)), np.ones((0, 3))], r"scans\[1\].*no points"),
    ],
)
def test_wrong_scans_are_named(scans, words):
    with pytest.raises(ValueError, match=words):
        jr.reconstruct(scans, key=jax.random.key(0))


@pytest.mark.parametrize(
    ("options", "error", "words"),
    [
        ({"order": "random"}, ValueError, "order: wanted 'any' or 'sequential'"),
        ({"previous": 3}, TypeError, "previous: wanted a Reconstr.*found int"),
        ({"hold_previous": True}, ValueError, "hold_previous: wanted a Rec.*NoneType"),
        ({"previous": MOTIONS}, ValueError, "previous: of 9 scans, but there are 8"),
    ],
)
def test_wrong_options_are_named(sculpture, options, error, words):
    with pytest.raises(error, match=words):
        jr.reconstruct(sculpture[0], key=jax.random.key(0), method=FILTER, **options)


@pytest.mark.parametrize(
    ("viewpoints", "words"),
    [
        (np.zeros(3), r"viewpoints: .*\(3,\) for each of 8 scans.*found shape \(3,\)"),
        ([None] * 7, r"each of 8 scans, found shape \(7, 3\)"),
        ([np.zeros(2)] + [None] * 7, r"viewpoints\[0\]: wanted shape \(3,\) or None"),
        (np.full((8, 3), np.nan), r"viewpoints\[0\]: wanted finite.*None where"),
    ],
)
def test_wrong_viewpoints_are_named(sculpture, viewpoints, words):
    with pytest.raises(ValueError, match=words):
        jr.reconstruct(sculpture[0], key=jax.random.key(0), viewpoints=viewpoints)


def test_a_viewpoint_on_a_point_is_refused(sculpture):
    viewpoints = [None, sculpture[0][1][5], *6 * [None]]
    with pytest.raises(ValueError, match=r"viewpoints\[1\]: is a point.*row 5"):
        jr.reconstruct(sculpture[0], key=jax.random.key(0), viewpoints=viewpoints)


def test_map_coordinates_keep_their_digits(sculpture):
    scans, truth = sculpture
    middles = np.array([5e5, 4.2e6, 120]) + 0.3 * np.arange(8)[:, None]
    far = [s.astype(np.float64) + m for s, m in zip(scans, middles, strict=True)]
    found = []
    sol = jr.reconstruct(
        far, key=jax.random.key(0), method=FILTER, on_pairs=found.append
    )
    assert np.all(sol.placed)
    first = np.linalg.inv(truth[0])
    for s, T, T_true, m in zip(far, sol.T_world_i, truth, middles, strict=True):
        assert T.dtype == np.float64
        wanted = move(first @ T_true, s - m) + middles[0]
        assert np.max(np.linalg.norm(move(T, s) - wanted, axis=1)) < 0.005
    # Pairs that were told lead to the same poses, to the last bit of float32.
    told = RelativeMotions.joined(found)
    again = jr.reconstruct(far, key=jax.random.key(0), method=FILTER, previous=told)
    for s, T, T_again in zip(far, sol.T_world_i, again.T_world_i, strict=True):
        assert np.max(np.linalg.norm(move(T, s) - move(T_again, s), axis=1)) < 1e-5
