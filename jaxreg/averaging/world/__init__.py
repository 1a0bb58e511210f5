"""Poses in a world of which some poses, or some points, are known."""
