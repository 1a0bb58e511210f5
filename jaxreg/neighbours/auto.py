"""Which exact index for how many targets."""

from jaxreg.neighbours.base import AbstractIndex
from jaxreg.neighbours.box_tree import BoxTree
from jaxreg.neighbours.brute import BruteForce


# One core, millions of queries a second, brute force against box tree: 15 / 7 at 200
# targets, 7 / 7 at 500, 4 / 6 at 1,000, 0.5 / 2.7 at 10,000.
_CROSSOVER = 512


def exact_index(num_targets: int) -> type[AbstractIndex]:
    """The faster exact index, for queries in spatial order."""
    return BruteForce if num_targets <= _CROSSOVER else BoxTree
