"""Trees of arrays in one file that many processes map, and none copies."""

import mmap
import pickle
from typing import IO, Any


# Bytes that an array begins at a multiple of, so that JAX takes it where it is.
_ALIGNED = 64


def write_tree(file: IO[bytes], tree: Any) -> None:
    """A pickle of all but the arrays, then these one by one.

    Args:
        file: opened to be written, whatever it holds already.
        tree: whatever pickles, with NumPy arrays as leaves.
    """
    arrays: list[memoryview] = []
    rest = pickle.dumps(
        tree, protocol=5, buffer_callback=lambda x: arrays.append(x.raw())
    )
    pickle.dump((rest, [x.nbytes for x in arrays]), file)
    for x in arrays:
        file.write(bytes(-file.tell() % _ALIGNED))
        file.write(x)


def read_tree(file: IO[bytes]) -> Any:
    """What `write_tree` wrote, with arrays of NumPy that lie in the mapped file.

    `jax.device_put` takes them where they are on a CPU. The file may be removed then
    where the system keeps what is mapped, as Linux does.

    Raises:
        ValueError: if the file ends too early.
    """
    rest, sizes = pickle.load(file)
    start = file.tell()
    whole = memoryview(mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ))
    arrays = []
    for size in sizes:
        start += -start % _ALIGNED
        arrays.append(whole[start : start + size])
        start += size
    if start > len(whole):
        raise ValueError("ends too early")
    return pickle.loads(rest, buffers=arrays)
