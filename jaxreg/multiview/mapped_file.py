"""Trees of arrays in one file that many processes map, and none copies."""

import mmap
import pickle
from pathlib import Path
from typing import Any

import jax


# Bytes that an array begins at a multiple of, so that JAX takes it where it is.
_ALIGNED = 64


def write_tree(path: Path, tree: Any) -> None:
    """A pickle of all but the arrays, then these one by one.

    Args:
        path: of the file.
        tree: whatever pickles, with NumPy arrays as leaves.
    """
    arrays: list[memoryview] = []
    rest = pickle.dumps(
        tree, protocol=5, buffer_callback=lambda x: arrays.append(x.raw())
    )
    with path.open("wb") as file:
        pickle.dump((rest, [x.nbytes for x in arrays]), file)
        for x in arrays:
            file.write(bytes(-file.tell() % _ALIGNED))
            file.write(x)


def read_tree(path: Path) -> Any:
    """What `write_tree` wrote, with arrays of JAX that lie in the mapped file on CPU.

    The file may be removed then where the system keeps what is mapped, as Linux does.
    """
    with path.open("rb") as file:
        rest, sizes = pickle.load(file)
        start = file.tell()
        whole = memoryview(mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ))
    arrays = []
    for size in sizes:
        start += -start % _ALIGNED
        arrays.append(whole[start : start + size])
        start += size
    return jax.device_put(pickle.loads(rest, buffers=arrays))
