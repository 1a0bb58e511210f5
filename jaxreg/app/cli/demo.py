"""`jaxreg demo`: a sculpture scanned from twelve views, put together again."""

from jaxreg.app.cli import outputs
from jaxreg.app.cli.inputs import Scans
from jaxreg.app.cli.multiview import reconstruct_scans, report
from jaxreg.app.cli.options import Demo
from jaxreg.app.cli.runtime import Session, key_of, method_of
from jaxreg.datasets.sculpture import sculpture_scans


def run(command: Demo, session: Session) -> int:
    """Runs the command; returns the exit code."""
    key, method = key_of(command), method_of(command)
    session.console.print(
        "Twelve noisy scans of a sculpture 0.2 m tall, each in a frame of its own, "
        "no initial guess."
    )
    with session.timed("generate"):
        points, T_world_i = sculpture_scans(12, seed=command.seed)
    names = [f"view{k:02d}" for k in range(len(points))]
    scans = Scans(names, points, names)
    with session.progress() as progress, session.timed("run", computes=True):
        result = reconstruct_scans(scans, key, method, progress)
    errors = outputs.pose_errors(result, names, T_world_i)
    return report(session, result, scans, errors)
