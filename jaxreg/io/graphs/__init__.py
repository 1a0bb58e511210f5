"""Pose graphs and relative motions in files."""
