"""How many edges lie between two nodes of a graph, of many pairs of nodes.

Breadth-first from many nodes side by side, a bit for each (MS-BFS, Then et al. 2014),
on the host.
"""

import numpy as np


# Nodes whose searches share a number.
_BITS = 64


def hops(edges: np.ndarray, pairs: np.ndarray, num_nodes: int, most: int) -> np.ndarray:
    """`(p,)` edges on the shortest way between the nodes of each pair, up to `most`.

    Args:
        edges: `(e, 2)` nodes that are joined, in either order.
        pairs: `(p, 2)` nodes.
        num_nodes: v.
        most: what is told of longer ways, and where there is none.
    """
    out = np.zeros(len(pairs), int)
    starts, row = np.unique(pairs[:, 0], return_inverse=True)
    order = np.argsort(row, kind="stable")
    block = row[order] // _BITS
    first = np.searchsorted(block, np.arange(-(-len(starts) // _BITS) + 1))
    of_node, begin, neighbour = _neighbours(edges)
    for k, (low, high) in enumerate(zip(first[:-1], first[1:], strict=True)):
        some = order[low:high]
        ends, bit = pairs[some, 1], (row[some] % _BITS).astype(np.uint64)
        nodes = starts[k * _BITS : (k + 1) * _BITS]
        seen = np.zeros(num_nodes, np.uint64)
        seen[nodes] = np.uint64(1) << np.arange(len(nodes), dtype=np.uint64)
        for _ in range(most):
            far = (seen[ends] >> bit) & np.uint64(1) == 0
            if not far.any():
                break
            out[some[far]] += 1
            if len(of_node):
                seen[of_node] |= np.bitwise_or.reduceat(seen[neighbour], begin)
    return out


def _neighbours(edges: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Nodes with edges, where their neighbours begin, and these, node by node."""
    both = np.concatenate([edges, edges[:, ::-1]])
    both = both[np.argsort(both[:, 0], kind="stable")]
    of_node, begin = np.unique(both[:, 0], return_index=True)
    return of_node, begin, both[:, 1]
