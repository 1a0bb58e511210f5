"""Poses to start from: safest trees, by the evidence of cycles."""
