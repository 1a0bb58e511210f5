"""Rigid motions and closed-form fits."""
