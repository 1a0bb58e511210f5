"""Workloads: each module has `cases(options)`, which yields what is measured.

A workload runs in a process of its own, pinned to its cores, so that one cannot disturb
the next: neither by precision, nor by memory, nor by a crash.
"""

from typing import Literal, NamedTuple


class Workload(NamedTuple):
    """What is known of a workload before its process starts.

    Attributes:
        title: for the report.
        text: what it measures and how, for the report.
        cores: that its process is pinned to: one, or all that there are.
        double: whether JAX computes in float64 where asked.
        quick: whether it has cases of `--quick`.
        devices: whether each core is a device of JAX, or all of them one.
        pairs: whether its cases are pairs, told in one table.
    """

    title: str
    text: str
    cores: Literal["one", "all"] = "one"
    double: bool = False
    quick: bool = True
    devices: bool = False
    pairs: bool = False


WORKLOADS = {
    "local_pairs": Workload(
        "Local registration of a pair",
        "Disjoint random subsets of an object, the source turned by 10 degrees about a "
        "random axis through its centroid and moved by 5 % of the extent (the diagonal "
        "of the bounding box). All start from the identity. What is timed runs from "
        "NumPy points to a pose: conversion, normals, covariances and trees included. "
        "Success: below 1 degree and 1 % of the extent at the source's centroid.",
    ),
    "local_batch": Workload(
        "Local registration of many pairs",
        "Pairs as above, all in one call: one `register` of a batch, and the peers "
        "with as many threads or processes as there are cores.",
        cores="all",
        quick=False,
    ),
    "global_horse": Workload(
        "Global registration of a horse",
        "The PF paper's horse (400 points on 4,000) by its own protocol, under any "
        "rotation, and one half of it, with noise. Success as in the paper: 10 "
        "degrees, and 5 units at the model's middle. The target is prepared once where "
        "the method allows it, apart from the time of a trial.",
    ),
    "global_scans": Workload(
        "Global registration of real scans",
        "All pairs of the Bunny's and of the Dragon's scans, no guess. Scans are "
        "prepared once, apart from the time of a pair. Right: within 5 degrees and 5 "
        "mm at the source's centroid. Believed: what the method itself reports as "
        "found.",
        quick=False,
    ),
    "sensor_pairs": Workload(
        "Pairs of other people's sensors",
        "Lidars, depth cameras and objects of other projects, no guess, three keys. "
        "What is timed runs from NumPy points to a pose. Right: within 5 degrees and "
        "the tolerance of the data at the source's centroid. Believed: status "
        "CONVERGED; of peers, more than 0.3 of the points of either cloud within 1.5 "
        "voxels of the other.",
        cores="all",
        quick=False,
        pairs=True,
    ),
    "sensor_guesses": Workload(
        "Pairs of other people's sensors, locally",
        "Those of the pairs above for which a guess is published, from that guess. "
        "webots is 60 degrees from it. Right and believed as above.",
        cores="all",
        quick=False,
        pairs=True,
    ),
    "sensor_sequences": Workload(
        "Sequences of other people's sensors",
        "Scans of a lidar that moves into one frame, no guess. `placed`: scans of the "
        "largest group; `wrong`: those beyond 5 degrees and 0.6 m. Errors are those of "
        "the MCC paper, with the group's first scan as the common frame; all of the "
        "worst of three keys.",
        cores="all",
        quick=False,
    ),
    "look_ups": Workload(
        "Success against look-ups",
        "Searches that may look up equally many closest points: the filter, the filter "
        "without dynamics or with constant velocity, and plain descents from many "
        "starts.",
        quick=False,
    ),
    "filter_paper": Workload(
        "The particle filter's paper",
        "The PF paper's experiments. A part of a shape is displaced, and its pose as "
        "given is the guess: the letter S of words, 50 of a cube's 400 points, the "
        "front of a truck put at its rear. `look_ups` is how many closest points a "
        "search looks up at most (pairs, for kernel correlation); `as_shape` counts "
        "poses that look like the right one, too. Table 1 is the paper's, whose horse "
        "was another: `t` is by how much the model's middle is put wrong, `theta` the "
        "turn about z that is left, each with mean, deviation and largest size, "
        "`e_rot` the median of the whole rotation; success within 10 degrees and 5 "
        "units.",
        quick=False,
    ),
    "paper_readings": Workload(
        "Readings of both papers",
        "What the papers leave open, varied one at a time around what comes nearest to "
        "their figures; the documentation's page on readings has the sentence that "
        "each rests on. Table 1: `t` is by how much the model's middle is put wrong, "
        "`theta` by how much the angle of rotation is too large, `axis` the length of "
        "the difference of the axes. Tables II and III: graphs drawn with the errors "
        "of Table II, then motions that `reconstruct` finds; all but LRS start from "
        "its poses.",
        quick=False,
    ),
    "neighbours": Workload(
        "Closest points",
        "Targets on a sculpture; queries near its surface and after a turn of 10 "
        "degrees. Trees are built once, apart. `exact` is the share of answers that "
        "are the closest point.",
    ),
    "sensor_bound": Workload(
        "Accuracy beside the bound of the points seen",
        "The sculpture by a sensor with all its faults: noise that grows with the "
        "range, mixed pixels at edges, density by range, holes. `over_bound_R` and "
        "`over_bound_t` are root mean square errors over the bound of Cramer and Rao "
        "for the points that both, or several, scans see, the surface known exactly: 1 "
        "is the best there can be. Pairs start 3 degrees and 5 mm off.",
        quick=False,
    ),
    "averaging_outliers": Workload(
        "Motion averaging with outliers",
        "Random graphs, noise of 0.5 degrees and 0.5 % of the size, a share of the "
        "motions uniformly random; from the motions alone. Success: mean errors within "
        "5 degrees and 5 % in the best common frame. `as the truth`: success, or at "
        "least as many edges agree with the answer as with the true poses (a frame of "
        "one right and several wrong edges cannot be told apart by anybody).",
    ),
    "averaging_batch": Workload(
        "Motion averaging of many graphs",
        "Random graphs as above, all in one call: one after the other on one device of "
        "JAX, or on as many as there are cores, or side by side; GTSAM in as many "
        "processes as there are cores. Then single graphs, called as they are and "
        "inside the caller's `jit`.",
        cores="all",
        quick=False,
        devices=True,
    ),
    "averaging_paper": Workload(
        "Motion averaging of the MCC paper's tables",
        "Tables I to III of the MCC paper on the motions that `reconstruct` estimates "
        "without a guess, each pair of scans once: those that it trusts, those of "
        "largest overlap (the paper's share of all pairs), and all, most of them of "
        "scans that share no surface. All edges weigh the same but in wMA and where "
        "overlap is named, which weighs them. `agree`: edges whose rotation is within "
        "0.1 rad of that of the answer. Means over two seeds of the motions.",
        quick=False,
    ),
    "averaging_logs": Workload(
        "Motion averaging of real logs",
        "Relative motions that fast global registration found between the views of "
        "indoor scenes, most of them wrong. `frames` is the share of frames within the "
        "bounds in the common frame that has most of them.",
        quick=False,
    ),
    "pose_graphs": Workload(
        "Public pose graphs",
        "Graphs with published optima, from the motions alone, float64. `ratio` is "
        "SE-Sync's chordal objective over the optimum.",
        double=True,
        quick=False,
    ),
    "false_closures": Workload(
        "False loop closures",
        "Public pose graphs with false closures, float64: two random poses with the "
        "motion and information of a true closure taken at random. From the motions "
        "alone but where named. Distances from the clean optimum (chordal, without the "
        "false ones) in the best common frame: medians over seeds of the means; "
        "`e_t_max` and counts are those of the worst seed. `ratio` is SE-Sync's "
        "objective of the true edges over its optimum. The picture shows the first "
        "seed.",
        double=True,
        quick=False,
    ),
    "large_graphs": Workload(
        "Large graphs",
        "A path in rings of 100 poses, 3.85 edges a pose, noise of 1 degree and 0.02 "
        "of a step; wrong edges join random poses by the motion of a true closure. "
        "From the motions alone, float64. `wrong trusted` and `right lost`: edges, "
        "where a method tells. GTSAM is left out where wrong closures fill its "
        "elimination and a call would take minutes. A chain is a drive through streets "
        "with a tenth of that noise; where it passes a place again, five frames in a "
        "row close loops. Of a million poses float32.",
        double=True,
    ),
    "growing_maps": Workload(
        "Growing maps",
        "Ten more poses on a thousand of `large_graphs` by `average(previous=)`, and "
        "beside it a graph of these ten alone, and all anew. Errors: of all poses. Ten "
        "more scans on a thousand of the street of `many_scans`, made ready as a set, "
        "whose poses are held, and beside it these ten alone: all but the search. "
        "Errors: of the ten, after the best motion of all.",
        quick=False,
    ),
    "multiview": Workload(
        "Many scans into one frame",
        "Scans to poses, no guess. Errors are those of the MCC paper, e_R and e_t, "
        "with scan 0 as the common frame. `surfaces` is how far overlapping scans are "
        "from each other along normals, `surfaces_truth` at the published poses: the "
        "median over pairs of their medians.",
    ),
    "multiview_robust": Workload(
        "Many scans of which some do not belong",
        "As above with a foreign scan, a scan twice, two objects, or half of all "
        "points uniform noise in the box of each scan. `right`: scans within 5 degrees "
        "and 5 mm of their object's first, and foreign ones left out, at the worst "
        "seed; `wrong`: scans placed elsewhere.",
        quick=False,
    ),
    "multiview_size": Workload(
        "Many scans: time against their number",
        "The sculpture from ever more sides, no guess; and views cut from a real "
        "kitchen's fragments, from cameras that look anywhere. `pairs` is how many "
        "registrations were spent.",
        quick=False,
    ),
    "many_scans": Workload(
        "Ten thousand scans: all but the search",
        "Scans of 400 points along a street, or of an object from all sides. What the "
        "search would say of a pair is drawn from the truth, right where scans share "
        "0.3 of what they see, else wrong, and once in a thousand believed all the "
        "same; what is timed is the rest of `reconstruct`: preparing scans, choosing "
        "pairs, averaging, measuring overlapping pairs again, judging.",
        cores="all",
        quick=False,
    ),
    "command_line": Workload(
        "What a person waits for at the terminal",
        "Commands as processes of their own, from an empty folder to written files, "
        "pictures and page: with an empty cache folder, so that they compile, and with "
        "that of an earlier call. `compile` and `run` are parts of that time as the "
        "command reports them. `objective` is SE-Sync's, at the worst seed; "
        "before, it is that of the spanning tree.",
        cores="all",
        double=True,
        quick=False,
    ),
    "gradients": Workload(
        "Gradients",
        "Gradients of a sum over the answer beside the answer itself, float64, and how "
        "far a derivative is off what it must be.",
        double=True,
        quick=False,
    ),
    "solvers": Workload(
        "Our steps and other solvers",
        "ICP, kernel correlation and a pose graph by our own steps, by solvers of "
        "optimistix in their place, and by those of lineax within them; from the same "
        "starts, float64 for the graph. `off`: the largest entry by which poses differ "
        "from the minimum. `steps` are ours, or evaluations of the solver; of ICP "
        "matches.",
        double=True,
        quick=False,
    ),
    "compile_times": Workload(
        "Compile times",
        "First calls after caches were emptied: tracing, compiling and one run, of "
        "`register` of 1,000 points, `average` of 32 poses and 465 edges, and "
        "`reconstruct` of four scans, beside a fixed program of XLA. Wall time is that "
        "of all cores.",
        cores="all",
        quick=False,
    ),
    "devices": Workload(
        "Devices",
        "Throughput on the CPU and, where there is one, the accelerator: the same "
        "code.",
        cores="all",
        quick=False,
    ),
}
