"""A script as GTSAM's users write it: optimises a g2o file of a graph in space.

Run: python gtsam_script.py IN.g2o OUT.g2o

Prints the seconds between reading and writing.
"""

import sys
import time

import gtsam  # pyright: ignore[reportMissingImports]
import numpy as np


def main(source: str, target: str) -> None:
    """Chordal relaxation, then Levenberg-Marquardt, with the first pose held."""
    graph, _ = gtsam.readG2o(source, True)
    start = time.perf_counter()
    loose = gtsam.noiseModel.Diagonal.Variances(np.full(6, 1e-6))
    held = gtsam.NonlinearFactorGraph(graph)
    held.add(gtsam.PriorFactorPose3(0, gtsam.Pose3(), loose))
    begin = gtsam.InitializePose3.initialize(held)
    found = gtsam.LevenbergMarquardtOptimizer(held, begin).optimize()
    print(time.perf_counter() - start)
    gtsam.writeG2o(graph, found, target)


if __name__ == "__main__":
    main(*sys.argv[1:])
