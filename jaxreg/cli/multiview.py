"""`jaxreg multiview`: many scans into one frame."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import tyro

from jaxreg._core.status import Status
from jaxreg._core.typing import Progress
from jaxreg.cli import outputs
from jaxreg.cli.inputs import Scans, load_scans
from jaxreg.cli.runtime import Options, Session
from jaxreg.io.atomic import require_writable
from jaxreg.io.errors import InputError
from jaxreg.io.result import Result
from jaxreg.io.stanford import read_conf


FILES = (
    "result.json",
    "poses.tum",
    "graph.g2o",
    "merged.ply",
    "figure.png",
    "report.html",
)


@dataclass(frozen=True)
class Multiview(Options):
    """Bring scans into one frame, without an initial guess."""

    scans: Annotated[
        tyro.conf.Positional[tuple[Path, ...]], tyro.conf.arg(metavar="SCAN ...")
    ]
    """Two or more files (PLY, XYZ, CSV, TXT, NPY), a folder, or an NPZ of scans."""
    truth: Path | None = None
    """Pose file of the Stanford repository (.conf, metres): adds a table of errors."""

    def run(self, session: Session) -> int:
        """Runs the command; returns the exit code."""
        with session.timed("read"):
            if not self.scans:
                raise InputError(
                    "No scans given.\nUsage: jaxreg multiview SCAN SCAN ..."
                )
            scans = load_scans(self.scans)
            truth = None if self.truth is None else _read_truth(self.truth, scans)
        require_writable(self.out)
        key = self.key()
        with session.progress() as progress, session.timed("run", computes=True):
            result = reconstruct_scans(scans, key, progress)
        require_two_placed(result, scans)
        errors = None if truth is None else outputs.pose_errors(result, *truth)
        report(session, result, scans, errors)
        return 0


def reconstruct_scans(scans: Scans, key: Any, progress: Progress) -> Result:
    """Reconstructs centred scans and moves the answer to the frames of the files."""
    import jaxreg

    centred, middles = scans.centred()
    sol = jaxreg.reconstruct(centred, key=key, progress=progress)
    placed, keep = np.asarray(sol.placed), np.asarray(sol.graph.mask)
    world = middles[np.argmax(placed)]  # the frame of the first placed scan
    edges = np.asarray(sol.graph.edges)[keep]
    i, j = edges.T
    return Result(
        names=scans.names,
        T_world_i=outputs.uncentre(np.asarray(sol.T_world_i), world, middles),
        placed=placed,
        status=Status(int(sol.status)),
        scan_status=np.asarray(sol.scan_status),
        num_points=np.array([len(x) for x in scans.points]),
        num_dropped=np.asarray(sol.num_dropped),
        edges=edges,
        T_i_j=outputs.uncentre(
            np.asarray(sol.graph.T_i_j)[keep], middles[i], middles[j]
        ),
        overlap=np.asarray(sol.overlap)[keep],
        weight=np.asarray(sol.edge_weight)[keep],
        inlier_rmse=np.asarray(sol.inlier_rmse)[keep],
    )


def require_two_placed(result: Result, scans: Scans) -> None:
    """Refuses a result in which no two scans could be joined.

    Raises:
        InputError: that names the scans, or the first of them and their number.
    """
    if result.placed.sum() >= 2:
        return
    places = scans.places
    who = (
        " and ".join(places)
        if len(places) == 2
        else f"{places[0]} and {len(places) - 1} more"
    )
    status = (
        result.status if result.status != Status.DISCONNECTED else Status.LOW_OVERLAP
    )
    raise InputError(f"{who}: no two scans could be joined.\n{status.advice}")


def report(
    session: Session, result: Result, scans: Scans, errors: dict[str, Any] | None
) -> None:
    """Writes the files and prints the tables."""
    outputs.write_files(session, result, scans.points, errors)
    outputs.show_scans(session, result)
    if errors is not None:
        outputs.show_errors(session, errors)
    outputs.show_end(session, FILES, session.options.out)


def _read_truth(path: Path, scans: Scans) -> tuple[list[str], np.ndarray]:
    poses = read_conf(path)
    if scans.points[0].shape[1] != 3:
        raise InputError(f"{path}: holds 3D poses, but the scans are 2D.")
    common = [name for name in scans.names if name in poses]
    if len(common) < 2:
        raise InputError(
            f"{path}: holds poses of {', '.join(list(poses)[:3])}, ... but the scans "
            f"are {', '.join(scans.names[:3])}, ...\nGive the pose file of these scans."
        )
    return common, np.stack([poses[name] for name in common])
