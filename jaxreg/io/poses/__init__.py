"""Trajectories and poses in files."""
