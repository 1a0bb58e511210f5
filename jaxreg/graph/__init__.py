"""Relative motions between frames as a graph, and its trees."""

from jaxreg.graph.pose_graph import PoseGraph as PoseGraph
