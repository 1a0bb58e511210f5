"""The commands and their options, as `--help` tells of them.

Nothing here computes or imports what does: help, and a word on a wrong word, are there
at once. What a command does is in the module of its name.
"""

import math
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Literal, TypeAlias

import tyro

from jaxreg.io.errors import InputError


Precision: TypeAlias = Literal["float32", "float64"]
Order: TypeAlias = Literal["any", "sequential"]
AveragingMethod: TypeAlias = Literal["correntropy", "plain", "weighted"]


@dataclass(frozen=True, kw_only=True)
class Options:
    """Options of every command that computes."""

    out: Annotated[Path, tyro.conf.arg(metavar="FOLDER")] = Path("jaxreg-out")
    """For the results; made if needed."""
    seed: int = 0
    """Of the random numbers, 0 to 2^31 - 1; the same one gives the same result."""
    device: Literal["auto", "cpu", "gpu", "tpu"] = "auto"
    """To compute on; auto takes an accelerator if JAX finds one."""
    precision: Precision = "float32"
    """Of the computation; float64 has more digits and takes longer."""
    quiet: bool = False
    """Print nothing but errors."""
    json: bool = False
    """Print the content of result.json to standard output, and nothing else there."""


@dataclass(frozen=True, kw_only=True)
class SearchOptions(Options):
    """Options of the commands that search for poses of scans."""

    budget: int = 1536  # `ParticleFilter().num_prior`
    """Poses drawn at most for a pair of scans; more find harder pairs and take time."""
    upright: bool = False
    """The scanners were level: the last axis of every scan points up."""
    deviation: float = 1.0
    """Of positions that are given, in the unit of the scans."""

    def check_known(self, dim: int) -> None:
        """Requires 3D scans of what is upright, and a deviation above zero."""
        if self.upright and dim != 3:
            raise InputError("--upright: of 3D scans only, these are 2D.")
        if not 0 < self.deviation < math.inf:
            raise InputError(
                f"--deviation {self.deviation}: wanted a number above zero."
            )


@dataclass(frozen=True)
class Demo(SearchOptions):
    """Scan a sculpture from twelve views, reconstruct it, compare to the truth."""


@dataclass(frozen=True)
class Register(SearchOptions):
    """Move one scan onto another, without an initial guess."""

    source: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="SOURCE")]
    """The scan that moves: PLY, XYZ, PCD, LAS, OBJ, ..., or FILE.npz:KEY."""
    target: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="TARGET")]
    """The scan that stays; its frame is that of the result."""

    position: Annotated[
        tuple[float, ...] | None,
        tyro.conf.arg(metavar="X Y [Z]", help_behavior_hint="(default: unknown)"),
    ] = None
    """About where the source's origin is in the target's frame; see --deviation."""


@dataclass(frozen=True)
class Multiview(SearchOptions):
    """Bring scans into one frame, without an initial guess."""

    scans: Annotated[
        tyro.conf.Positional[tuple[Path, ...]],
        tyro.conf.arg(metavar="SCAN ...", help_behavior_hint="(required)"),
    ]
    """Files (PLY, XYZ, PCD, LAS, ...), a folder of these, or an archive (NPZ, E57)."""
    truth: Annotated[
        Path | None,
        tyro.conf.arg(metavar="FILE.conf", help_behavior_hint="(default: none)"),
    ] = None
    """Poses as the Stanford repository has them, metres: adds a table of errors."""
    order: Order = "any"
    """Of the scans; sequential if each overlaps the next: fewer pairs are tried."""
    viewpoint: Annotated[
        tuple[float, ...] | None,
        tyro.conf.arg(metavar="X Y [Z]", help_behavior_hint="(default: unknown)"),
    ] = None
    """Where the scanner stood in the frame of every scan, in its unit: often 0 0 0."""
    positions: Annotated[
        Path | None,
        tyro.conf.arg(metavar="FILE", help_behavior_hint="(default: none)"),
    ] = None
    """Lines NAME X Y [Z]: about where each scan's scanner stood; see --deviation."""
    resume: bool = False
    """Go on with the pairs that an interrupted run left in the output folder."""


@dataclass(frozen=True)
class Average(Options):
    """Find poses that agree with the relative motions of a pose graph."""

    graph: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="GRAPH.g2o")]
    """A g2o file; its vertices are not used, the answer comes from its edges alone."""
    method: AveragingMethod = "correntropy"
    """Correntropy bears wrong edges; plain and weighted are for graphs without any."""
    precision: Precision = field(default="float64", kw_only=True)
    """Of the computation; graphs of thousands of poses need the digits."""
    budget: Annotated[
        int | None,
        tyro.conf.arg(
            metavar="INT", help_behavior_hint="(default: 100; plain, weighted: 50)"
        ),
    ] = None
    """Steps of the method, at most."""


@dataclass(frozen=True)
class Info:
    """Tell what files of scans or pose graphs hold."""

    files: Annotated[
        tyro.conf.Positional[tuple[Path, ...]],
        tyro.conf.arg(metavar="FILE ...", help_behavior_hint="(required)"),
    ]
    """Scans, archives of scans, folders of these, pose graphs (g2o, TORO .graph)."""
    json: bool = False
    """Print one JSON object instead."""


COMMANDS = (
    Annotated[Demo, tyro.conf.subcommand("demo")]
    | Annotated[Register, tyro.conf.subcommand("register")]
    | Annotated[Multiview, tyro.conf.subcommand("multiview")]
    | Annotated[Average, tyro.conf.subcommand("average")]
    | Annotated[Info, tyro.conf.subcommand("info")]
)
