"""Indexes of closest points."""

from jaxreg.neighbours.auto import exact_index as exact_index
from jaxreg.neighbours.base import AbstractIndex as AbstractIndex
from jaxreg.neighbours.base import Neighbours as Neighbours
from jaxreg.neighbours.box_tree import BoxTree as BoxTree
from jaxreg.neighbours.brute import BruteForce as BruteForce
from jaxreg.neighbours.correspondences import correspondences as correspondences
from jaxreg.neighbours.voxel_table import VoxelTable as VoxelTable
