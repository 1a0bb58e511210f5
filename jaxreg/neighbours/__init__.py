"""Indexes of closest points."""

from jaxreg.neighbours.auto import exact_index as exact_index
from jaxreg.neighbours.auto import index_within as index_within
from jaxreg.neighbours.base import AbstractIndex as AbstractIndex
from jaxreg.neighbours.base import Neighbours as Neighbours
from jaxreg.neighbours.box_tree import BoxTree as BoxTree
from jaxreg.neighbours.brute import BruteForce as BruteForce
from jaxreg.neighbours.builder import IndexBuilder as IndexBuilder
from jaxreg.neighbours.builder import IndexOptions as IndexOptions
from jaxreg.neighbours.builder import check_index as check_index
from jaxreg.neighbours.cell_grid import CellGrid as CellGrid
from jaxreg.neighbours.correspondences import correspondences as correspondences
from jaxreg.neighbours.voxel_table import VoxelTable as VoxelTable
