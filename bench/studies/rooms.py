"""Views of a room: which come together, and are they where they belong?

    python -m bench.studies.rooms --views 24 --seeds 0 1 2 3

Cameras about the middle of a real kitchen look anywhere (`bench/room_views.py`), so
many see little but a wall, and walls that meet at right angles fit in many ways.
"""

import argparse
import time
from pathlib import Path

import jax
import numpy as np

from bench.room_views import room_views
from jaxreg import reconstruct
from jaxreg.metrics import rotation_errors, translation_errors


# A view is right within these of most of its part.
_DEGREES, _METRES = 5.0, 0.15


def num_wrong(T_world_i: np.ndarray, T_true: np.ndarray) -> int:
    """Views of a part that lie elsewhere than by the frame that most agree with."""
    num = []
    for frame in range(len(T_true)):
        T, T_wanted = (np.roll(x, -frame, axis=0) for x in (T_world_i, T_true))
        turn = np.degrees(rotation_errors(T, T_wanted))
        shift = translation_errors(T, T_wanted)
        num.append(int(np.sum((turn > _DEGREES) | (shift > _METRES))))
    return min(num)


def main() -> None:
    """Prints a line for each set of views."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--views", type=int, default=24)
    parser.add_argument("--seeds", type=int, nargs="+", default=[0])
    parser.add_argument("--key", type=int, default=0)
    parser.add_argument("--data", type=Path, default=Path("../shared/data"))
    args = parser.parse_args()
    for seed in args.seeds:
        views, T = room_views(args.data / "kitchen_fragments", args.views, seed)
        start = time.process_time()
        found = reconstruct(views, key=jax.random.key(args.key))
        taken = time.process_time() - start
        part, T_found = np.asarray(found.component), np.asarray(found.T_world_i)
        parts = [np.flatnonzero(part == k) for k in range(part.max() + 1)]
        wrong = sum(num_wrong(T_found[rows], T[rows]) for rows in parts)
        print(
            f"seed {seed}: parts of {' and '.join(str(len(rows)) for rows in parts)}, "
            f"{np.sum(part < 0)} alone, {wrong} wrong; "
            f"{len(found.overlap)} pairs, {taken:.0f} s of CPU",
            flush=True,
        )


if __name__ == "__main__":
    main()
