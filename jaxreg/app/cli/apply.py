"""`jaxreg apply`: scans moved by poses that are written already."""

import sys
from pathlib import Path

import numpy as np

from jaxreg.app.aligned import ScanFile, list_scans, write_aligned
from jaxreg.app.cli.options import Apply
from jaxreg.app.folder import held
from jaxreg.app.trajectories import Trajectory, read_trajectory
from jaxreg.io.atomic import atomic_folder
from jaxreg.io.errors import InputError
from jaxreg.io.printable import printable


def run(command: Apply) -> int:
    """Runs the command; returns the exit code."""
    if not command.scans:
        raise InputError("No scans given.\nUsage: jaxreg apply POSES SCAN ...")
    poses = precise_poses(command.poses)
    scans = list_scans(command.scans)
    motions = _motions(poses, scans, command.poses)
    if command.inverse:
        motions = {k: np.linalg.inv(T) for k, T in motions.items()}
    with held(command.out), atomic_folder(command.out) as staging:
        written = write_aligned(staging, scans, motions)
        _require_originals_kept(command.out, written, scans)
    if not command.quiet:
        left = [scan.name for k, scan in enumerate(scans) if k not in motions]
        lines = [f"{name}: has no pose, left out." for name in left]
        lines.append(f"Written to {command.out}: {', '.join(written)}.")
        sys.stdout.write(printable("\n".join(lines)) + "\n")
    return 0


def _require_originals_kept(
    out: Path, written: list[str], scans: list[ScanFile]
) -> None:
    """Refuses to put moved scans in place of those that were read.

    Raises:
        InputError: where a file that was read would be replaced.
    """
    read = {scan.file.resolve() for scan in scans}
    for name in written:
        if (out / name).resolve() in read:
            raise InputError(
                f"{out / name}: is a scan that is read; it would be replaced.\n"
                "Give another folder: --out FOLDER."
            )


def precise_poses(path: Path) -> Trajectory:
    """Read in float64 whatever JAX computes in: maps have seven digits before it."""
    import jax

    with jax.enable_x64(True):
        return read_trajectory(path)


def _motions(
    poses: Trajectory, scans: list[ScanFile], path: Path
) -> dict[int, np.ndarray]:
    """`T_world_i` by number of the scan.

    Raises:
        InputError: if it cannot be told which pose is whose.
    """
    if poses.pairs is not None:
        raise InputError(
            f"{path}: holds motions of pairs, not poses.\n"
            "Average them first: jaxreg average, then apply its result.json."
        )
    T, names = poses.T_world_i, [scan.name for scan in scans]
    if poses.names is not None:
        rows = {name: k for k, name in enumerate(poses.names)}
        found = {i: T[rows[name]] for i, name in enumerate(names) if name in rows}
        if not found and len(T) == len(scans) == 1:
            return {0: T[0]}
        if not found:
            raise InputError(
                f"{path}: holds poses of {', '.join(list(rows)[:3])}, ... but the "
                f"scans are {', '.join(names[:3])}, ...\nGive the poses of these scans."
            )
        return found
    if len(T) == len(scans):
        return dict(enumerate(T))
    numbers = poses.stamps.astype(int)
    known = poses.timed and np.array_equal(numbers, poses.stamps)
    if known and 0 <= numbers.min() and numbers.max() < len(scans):
        return dict(zip(numbers.tolist(), T, strict=True))
    raise InputError(
        f"{path}: holds {len(T)} poses without names, but there are {len(scans)} scans."
        "\nGive as many scans as poses, in their order."
    )
