"""Which index for how many targets."""

from jaxreg._core.typing import Mask, Points, Scalar
from jaxreg.neighbours.base import AbstractIndex
from jaxreg.neighbours.box_tree import BoxTree
from jaxreg.neighbours.brute import BruteForce
from jaxreg.neighbours.cell_grid import CellGrid


# Millions of queries a second of `lookup` in a loop on one core, float32, 3D, as many
# sorted queries as targets, brute force / box tree: 8.0 / 3.1 at 200 targets,
# 7.3 / 2.8 at 500, 5.4 / 1.9 at 1,000, 3.1 / 1.5 at 2,000, 1.7 / 1.3 at 4,000,
# 1.36 / 1.33 at 5,000, 1.1 / 1.2 at 6,000, 0.9 / 1.1 at 8,000. A surface and a filled
# cube agree. Queries much denser than the targets make the tree's tiles compact: with
# 65,536 of them it is 5.9 / 4.0 at 1,000 and 0.7 / 2.1 at 10,000.
_CROSSOVER = 5000


def exact_index(num_targets: int) -> type[AbstractIndex]:
    """The faster exact index, for about as many queries, in spatial order."""
    return BruteForce if num_targets <= _CROSSOVER else BoxTree


# Milliseconds of a default ICP on one core by `exact_index` / cells: 4.1 / 5.3 at 500
# points, 11.2 / 10.1 at 2,000 (both brute force), 55 (tree) / 32 at 8,192.
_CROSSOVER_WITHIN = 1500


def index_within(points: Points, mask: Mask, radius: Scalar) -> AbstractIndex:
    """The fastest index, built, that is exact within a radius about the spacing."""
    if points.shape[0] <= _CROSSOVER_WITHIN:
        return BruteForce.build(points, mask)
    return CellGrid.build(points, mask, radius=radius)
