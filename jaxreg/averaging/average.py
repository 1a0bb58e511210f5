"""`average`: one pose per frame from relative motions."""

from collections.abc import Sequence
from typing import Any, overload

from jax.sharding import AbstractMesh, Mesh

from jaxreg._core.checks import check_callable, check_count, check_key, check_method
from jaxreg._core.log import log_solution
from jaxreg._core.typing import ArrayLike, Key, Progress
from jaxreg.averaging.base import AbstractAverager, AveragingSolution
from jaxreg.averaging.growing import average_grown, check_previous
from jaxreg.averaging.many import average_batch, average_list, average_one, check_init
from jaxreg.averaging.methods.correntropy import Correntropy
from jaxreg.averaging.world.arguments import check_known
from jaxreg.averaging.world.solve import average_known
from jaxreg.batching.devices import chosen_devices
from jaxreg.graph.pose_graph import PoseGraph, check_graph


@overload
def average(
    graph: PoseGraph,
    method: AbstractAverager | None = None,
    init: ArrayLike | None = None,
    key: Key | None = None,
    *,
    batch_size: int | None = None,
    progress: Progress | None = None,
    mesh: Mesh | AbstractMesh | None = None,
    priors: Sequence[tuple[Any, ...]] | None = None,
    fixed: Sequence[tuple[Any, ...]] | None = None,
    control: Sequence[tuple[Any, ...]] | None = None,
    levels: Sequence[tuple[Any, ...]] | None = None,
    previous: AveragingSolution | None = None,
) -> AveragingSolution: ...


@overload
def average(
    graph: Sequence[PoseGraph],
    method: AbstractAverager | None = None,
    init: ArrayLike | None = None,
    key: Key | None = None,
    *,
    batch_size: int | None = None,
    progress: Progress | None = None,
    mesh: Mesh | AbstractMesh | None = None,
    priors: Sequence[tuple[Any, ...]] | None = None,
    fixed: Sequence[tuple[Any, ...]] | None = None,
    control: Sequence[tuple[Any, ...]] | None = None,
    levels: Sequence[tuple[Any, ...]] | None = None,
    previous: AveragingSolution | None = None,
) -> list[AveragingSolution]: ...


def average(
    graph: PoseGraph | Sequence[PoseGraph],
    method: AbstractAverager | None = None,
    init: ArrayLike | None = None,
    key: Key | None = None,
    *,
    batch_size: int | None = None,
    progress: Progress | None = None,
    mesh: Mesh | AbstractMesh | None = None,
    priors: Sequence[tuple[Any, ...]] | None = None,
    fixed: Sequence[tuple[Any, ...]] | None = None,
    control: Sequence[tuple[Any, ...]] | None = None,
    levels: Sequence[tuple[Any, ...]] | None = None,
    previous: AveragingSolution | None = None,
) -> AveragingSolution | list[AveragingSolution]:
    """Finds poses that agree with relative motions: `T_i_j = inv(T_world_i) T_world_j`.

    Frame 0 is fixed at `init[0]`, or at the identity. Works under `jit`, `vmap` (over
    graphs with a leading axis on every array) and `grad`. The answer has the dtype of
    the graph and does not depend on the unit of length, unless `PoseGraphLM` is given
    no information.

        >>> import jaxreg as jr
        >>> east = [[1, 0, 1], [0, 1, 0], [0, 0, 1]]
        >>> far = [[1, 0, 2.3], [0, 1, 0], [0, 0, 1]]
        >>> edges = [(0, 1), (1, 2), (0, 2)]
        >>> graph = jr.PoseGraph.from_edges(edges, [east, east, far])
        >>> sol = jr.average(graph, jr.MotionAveraging())
        >>> sol.T_world_i[:, 0, 2].round(2)
        Array([0. , 1.1, 2.2], dtype=float32)

    Args:
        graph: the relative motions, see `PoseGraph.from_edges`; a list of graphs of any
            sizes; or a batch, a PoseGraph with a leading axis on all arrays.
        method: how to average; None for `Correntropy()`.
        init: `(v, d+1, d+1)` poses to start from, or None to start from the motions
            alone, as the method's docstring says. For a list of graphs a list, for a
            batch with its leading axis.
        key: for methods that draw random numbers; the others ignore it. Many graphs
            get one key each by splitting.
        batch_size: of many graphs, those that are averaged side by side; memory grows
            with it. By default one after another on a CPU, where that is quickest, and
            a million edges at a time on an accelerator.
        progress: called as `progress(stage, done, total)` as some graphs of a list are
            done; not for one graph or a batch, not under `jit`.
        mesh: a mesh of devices with an axis "pair", over which many graphs are spread,
            as `register` spreads pairs: without it they stay where a batch is.
        priors: what is nearly known of poses, a list of `(i, T_world_i)` or
            `(i, T_world_i, information)`, of one graph alone. The poses are then in
            their frame, and frame 0 is held by nothing else. After `method` all is
            adjusted by `PoseGraphLM`, with the trust in edges held; how much each prior
            is trusted is `prior_weight`, and fewer than half may be wrong. Information
            is of the right tangent error, as that of edges; without it a prior is as
            good as the middle edge.
        fixed: poses that are known exactly, a list of `(i, T_world_i)`. Edges between
            them say nothing and have `edge_weight` 0.
        control: surveyed points, a list of `(i, p_i, p_world)` or
            `(i, p_i, p_world, information)`: frame i sees at `p_i` what lies at
            `p_world`, such as a target, or, with `p_i` the place of the antenna, a
            satellite fix. They are adjusted to as priors are. Without priors and fixed
            poses three that are on no line are needed (two in 2D, or beside levels).
        levels: tilts that are known, of levelled scanners or inclinometers, a list of
            `(i, up_i, deviation)`: the direction `up_i` of frame i points along the
            last axis of the world, each of its two angles with that deviation, in
            radians. 3D alone; they are adjusted to as priors are, and hold neither
            place nor heading.
        previous: a solution of the graph before it grew: of its first frames and its
            first edges, all of them before the new ones, without what is known of
            poses. The answer is in its frame and, by `Correntropy`, takes the time of
            what is new: new frames, ends of new edges and what is near them move
            under the kernel of before, and where that moves more, more of them. Where
            a new edge contradicts the poses all is averaged anew, as only the whole
            tells which is wrong: a loop that closes far off costs that, as does a wrong
            one, once. So does a `previous` that did not converge, more than 1,024 new
            frames, or more than there were. Other methods, and graphs of up to
            `DENSE_LIMIT` frames, are averaged whole, from the poses of before. Not
            under `jit`, `vmap` and `grad`.

    Returns:
        An `AveragingSolution`, with leading axes for a batch; for a list a list of
        them, one for each graph. Status DISCONNECTED: some frames are not joined to
        frame 0 by edges of positive weight, see `placed`.
        NON_FINITE: edges or poses with NaN or inf were met; such edges are ignored,
        such poses returned as the identity.
        DEGENERATE: the control points that agree lie on a line, or beside levels on a
        vertical one; the poses are then in no world. MAX_STEPS: the steps ran out.
        NO_AGREEMENT: there are more motions than a tree needs, and nothing agrees
        beyond what any tree agrees with (`log_evidence` is at most 0, and so is that of
        the spanning tree of greatest weight); the poses of `Correntropy` are then those
        of its start. Or of priors and control points, or of levels, two and more
        without fixed poses, no more than half agree, or all had to bend and the middle
        one is still off by ten of its deviations.

    Raises:
        TypeError: if `graph` is no PoseGraph, or one of a list of another dtype,
            `method` no averaging method, `key` no key, or `previous` no solution.
        ValueError: if `init` has another shape than the poses or is no rigid motion
            within 1e-2, a batch has several leading axes, the graphs of a list differ
            in dimension or in whether they have information, or the mesh has no axis
            "pair"; or if a row of `priors`, `fixed`, `control` or `levels`, which is
            named, does not fit the graph, has a singular information, or fixes a frame
            twice; if `previous` is traced, has more frames or edges than the graph or
            another dimension or dtype, or is given beside `init`, `priors`, `fixed`,
            `control` or `levels`, or with many graphs.

    Positions in the world may be map coordinates: in NumPy arrays of float64 they are
    taken from the first before they are rounded to the dtype of the graph, and where
    the answer needs them `T_world_i` is a NumPy array of float64.

    Gradients: see the method. `T_world_i` always follows `init[0]`, or what is known;
    with priors, points or levels it is differentiated at the adjustment, trust held.

    Compilation: graphs of a list are padded to one of few numbers of poses, four an
    octave from 8 on, and to the edges of the largest that shares it; each such size
    compiles once. So is a graph of up to 128 poses outside of `jit`: to a power of two,
    and to one of edges, twice as many or more. Padding changes an answer by rounding.
    """
    method = Correntropy() if method is None else method
    check_method(method, AbstractAverager)
    if batch_size is not None:
        check_count(batch_size, "batch_size")
    check_callable(progress, "progress")
    key = None if key is None else check_key(key)
    beside = {"priors": priors, "fixed": fixed, "control": control, "levels": levels}
    told = any(x is not None for x in beside.values())
    many = isinstance(graph, list | tuple) or (
        isinstance(graph, PoseGraph) and graph.edges.ndim == 3
    )
    if told and many:
        raise ValueError(
            "priors, fixed, control, levels: of one graph, found many graphs."
        )
    if previous is not None:
        one = check_previous(previous, graph, {"init": init, **beside})
        solution = average_grown(one, method, previous, key)
        log_solution("average", solution)
        return solution
    if isinstance(graph, list | tuple):
        how = batch_size, progress, chosen_devices(mesh)
        return average_list(graph, method, init, key, *how)
    devices = chosen_devices(mesh, getattr(graph, "T_i_j", None))
    if isinstance(graph, PoseGraph) and graph.edges.ndim == 3:
        return average_batch(graph, method, init, key, batch_size, devices)
    one = check_graph(graph, "graph")
    start = check_init(init, one, "init")
    known = None
    if told:
        known = check_known(priors, fixed, control, levels, one, padded=True)
    if known is None:
        solution = average_one(one, method, start, key)
    else:
        solution = average_known(one, method, known, start, key)
    log_solution("average", solution)
    return solution
