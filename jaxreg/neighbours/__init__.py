"""Indexes of closest points."""

from jaxreg.neighbours.base import AbstractIndex as AbstractIndex
from jaxreg.neighbours.base import Neighbours as Neighbours
from jaxreg.neighbours.brute import BruteForce as BruteForce
from jaxreg.neighbours.voxel_table import VoxelTable as VoxelTable
