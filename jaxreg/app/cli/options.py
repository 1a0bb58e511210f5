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
Align: TypeAlias = Literal["first", "best", "positions", "none"]
PairMethod: TypeAlias = Literal["filter", "icp", "correlation"]
Color: TypeAlias = Literal["scan", "own"]
Unit: TypeAlias = Literal["mm", "cm", "m", "km", "in", "ft"]
#: Of each unit in metres.
UNITS: dict[Unit, float] = {
    "mm": 1e-3,
    "cm": 1e-2,
    "m": 1.0,
    "km": 1e3,
    "in": 0.0254,
    "ft": 0.3048,
}


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
class KnownOptions:
    """Options of the commands whose answer may lie in a known world.

    A frame is named as the input names it: a scan, or a number of a graph.
    """

    control: Annotated[
        Path | None,
        tyro.conf.arg(metavar="FILE", help_behavior_hint="(default: none)"),
    ] = None
    """Surveyed points: frame, [name,] [point in it,] point in the world [, sigma]."""
    level: Annotated[
        Path | None,
        tyro.conf.arg(metavar="FILE", help_behavior_hint="(default: none)"),
    ] = None
    """Tilts that are known, rows of: frame, what points up in it, sigma in radians."""
    fix: Annotated[
        tuple[str, ...],
        tyro.conf.arg(metavar="FRAME=POSE ...", help_behavior_hint="(default: none)"),
    ] = ()
    """Poses that stay: a file of one matrix, or its numbers in quotes."""


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


@dataclass(frozen=True, kw_only=True)
class ModelOptions(SearchOptions):
    """Options of the commands that write scans from files in one frame."""

    viewpoint: Annotated[
        tuple[float, ...] | None,
        tyro.conf.arg(metavar="X Y [Z]", help_behavior_hint="(default: unknown)"),
    ] = None
    """Where the scanner stood in the frame of every scan, in its unit: often 0 0 0."""
    save_aligned: bool = False
    """Write each scan whole in the common frame, too: its format, all it holds."""
    color: Color = "scan"
    """Of merged.ply: one for each scan, or the scans' own where they have them."""
    voxel: Annotated[
        float | None,
        tyro.conf.arg(metavar="FLOAT", help_behavior_hint="(default: by size)"),
    ] = None
    """Edge of cubes of which merged.ply has one point each; else two million points."""

    def check_model(self) -> None:
        """Requires an edge above zero."""
        if self.voxel is not None and not 0 < self.voxel < math.inf:
            raise InputError(f"--voxel {self.voxel}: wanted a number above zero.")


@dataclass(frozen=True)
class Demo(SearchOptions):
    """Scan a sculpture from twelve views, reconstruct it, compare to the truth."""


@dataclass(frozen=True)
class Register(ModelOptions):
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
    init: Annotated[
        str | None,
        tyro.conf.arg(
            metavar='FILE|"16 NUMBERS"', help_behavior_hint="(default: none)"
        ),
    ] = None
    """A guess: the matrix that maps the source to the target, or a result.json."""
    method: PairMethod = "filter"
    """The filter needs no guess; the others go on from one, or from the middles."""
    scale: bool = False
    """The source may also grow or shrink; of icp alone."""
    unit: Annotated[
        tuple[Unit, Unit] | None,
        tyro.conf.arg(
            metavar="SOURCE TARGET", help_behavior_hint="(default: the same)"
        ),
    ] = None
    """Units of both scans: mm, cm, m, km, in, ft; the result has the target's."""
    max_distance: Annotated[
        float | None,
        tyro.conf.arg(metavar="FLOAT", help_behavior_hint="(default: no limit)"),
    ] = None
    """Points farther from the target do not count; of icp alone."""

    def check_method(self) -> None:
        """Refuses options that the method cannot use."""
        if self.scale and self.viewpoint is not None:
            raise InputError("--viewpoint: not with --scale.")
        icp = {"--scale": self.scale, "--max-distance": self.max_distance is not None}
        search = {"--upright": self.upright, "--position": self.position is not None}
        wrong = icp if self.method != "icp" else {}
        wrong |= search if self.method != "filter" else {}
        for option in (name for name, given in wrong.items() if given):
            needed = "icp" if option in icp else "filter"
            raise InputError(f"{option}: only with --method {needed}.")
        if self.init is not None and any(search.values()):
            raise InputError("--init: takes the place of --upright and --position.")
        if self.max_distance is not None and not self.max_distance > 0:
            raise InputError(
                f"--max-distance {self.max_distance}: wanted a number above zero."
            )


@dataclass(frozen=True)
class Multiview(ModelOptions, KnownOptions):
    """Bring scans into one frame, without an initial guess."""

    scans: Annotated[
        tyro.conf.Positional[tuple[Path, ...]],
        tyro.conf.arg(metavar="SCAN ...", help_behavior_hint="(required)"),
    ]
    """Files (PLY, XYZ, PCD, LAS, BIN, ...), a folder, or an archive (NPZ, E57)."""
    truth: Annotated[
        Path | None,
        tyro.conf.arg(metavar="FILE.conf", help_behavior_hint="(default: none)"),
    ] = None
    """Poses as the Stanford repository has them, metres: adds a table of errors."""
    order: Order = "any"
    """Of the scans; sequential if each overlaps the next: fewer pairs are tried."""
    positions: Annotated[
        Path | None,
        tyro.conf.arg(metavar="FILE", help_behavior_hint="(default: none)"),
    ] = None
    """Lines NAME X Y [Z]: about where each scan's scanner stood; see --deviation."""
    unit: Annotated[
        Unit | None, tyro.conf.arg(metavar="UNIT", help_behavior_hint="(default: none)")
    ] = None
    """Of all scans, told beside lengths: mm, cm, m, km, in, ft."""
    resume: bool = False
    """Go on with the pairs that an interrupted run left in the output folder."""
    cluster: Annotated[
        str | None,
        tyro.conf.arg(
            metavar="local:N|ADDRESS", help_behavior_hint="(default: this process)"
        ),
    ] = None
    """Register pairs in N processes, or by a Dask scheduler (extra `cluster`)."""
    view: bool = False
    """Show scans, pairs and trust in the browser as they come; of the extra `view`."""


@dataclass(frozen=True)
class Average(Options, KnownOptions):
    """Find poses that agree with the relative motions of a pose graph."""

    graph: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="GRAPH")]
    """Motions of pairs, g2o or 3DMatch .log; initial poses in it are not used."""
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
    drop: Annotated[
        tuple[str, ...],
        tyro.conf.arg(metavar="I,J ...", help_behavior_hint="(default: none)"),
    ] = ()
    """Motions between these frames are left out."""
    force: Annotated[
        tuple[str, ...],
        tyro.conf.arg(metavar="I,J ...", help_behavior_hint="(default: none)"),
    ] = ()
    """Motions between these frames are right, whatever the others say."""


@dataclass(frozen=True)
class Apply:
    """Move scans by poses that are written already, whole and in their formats."""

    poses: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="POSES")]
    """A result.json, or poses as TUM, KITTI, g2o, .conf, .log, one 4 x 4 matrix."""
    scans: Annotated[
        tyro.conf.Positional[tuple[Path, ...]],
        tyro.conf.arg(metavar="SCAN ...", help_behavior_hint="(required)"),
    ]
    """Files, folders or archives of scans, in the order of poses without names."""
    out: Annotated[Path, tyro.conf.arg(metavar="FOLDER")] = Path("jaxreg-aligned")
    """For the moved scans; made if needed."""
    inverse: bool = False
    """The poses map the world to the scans; move by their inverses."""
    quiet: bool = False
    """Print nothing but errors."""


@dataclass(frozen=True)
class Evaluate:
    """Compare poses, or motions of pairs, with true ones."""

    estimate: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="ESTIMATE")]
    """A result.json, or poses as TUM, KITTI, g2o, .conf, .log; or a .log of pairs."""
    truth: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="TRUTH")]
    """The same; beside a .log of pairs its .info tells the registration recall."""

    align: Align = "first"
    """Frames first agree in this: the first pose, rotations (best), positions, none."""
    delta: int = 1
    """Frames between the two of a relative error."""
    max_difference: float = 0.01
    """Of two timestamps, in seconds, that count as one."""
    threshold: float = 0.2
    """Distance of coinciding points, up to which the motion of a pair is right."""
    out: Annotated[
        Path | None,
        tyro.conf.arg(metavar="FOLDER", help_behavior_hint="(default: none)"),
    ] = None
    """For evaluation.json and evaluation.png; made if needed."""
    json: bool = False
    """Print one JSON object instead."""


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
    | Annotated[Apply, tyro.conf.subcommand("apply")]
    | Annotated[Evaluate, tyro.conf.subcommand("evaluate")]
    | Annotated[Info, tyro.conf.subcommand("info")]
)
