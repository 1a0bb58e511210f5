"""Relative motions between frames as a graph."""
