"""What a g2o file knows of poses: fixed vertices, priors of poses and of positions.

Lines, after the classes of g2o: `FIX id ...`; `EDGE_PRIOR_SE2 id x y angle info`;
`EDGE_PRIOR_SE2_XY id x y info`; `EDGE_SE3_PRIOR id param pose info` and
`EDGE_SE3_XYZPRIOR id param position info`, whose sensor sits in the frame as a line
`PARAMS_SE3OFFSET param pose` says.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np

from jaxreg._core.checks import check_rigid
from jaxreg.geometry import lie
from jaxreg.io.errors import InputError
from jaxreg.io.graphs.g2o_file import KNOWN
from jaxreg.io.graphs.g2o_lines import Lines, Rows, columns, lines_of, motions


class KnownOfGraph(NamedTuple):
    """What `average` takes: `average(graph, **known._asdict())`.

    Attributes:
        priors: `(frame, T_world_i, information)` of each.
        fixed: `(frame, T_world_i)` of each.
        control: `(frame, p_i, p_world, information)` of each.
        levels: `(frame, up_i, deviation)` of each; g2o has no line of these.
    """

    priors: list[tuple[Any, ...]]
    fixed: list[tuple[Any, ...]]
    control: list[tuple[Any, ...]]
    levels: Sequence[tuple[Any, ...]] = ()


def known_of(lines: Lines, ids: np.ndarray, vertices: Rows, d: int) -> KnownOfGraph:
    """Reads them; frames are places in `ids`."""
    offsets = {}
    if d == 3:
        rows = lines.rows("PARAMS_SE3OFFSET", *KNOWN["PARAMS_SE3OFFSET"])
        each = motions(rows, 3, lines.path)
        offsets = dict(zip(rows.ids[:, 0].tolist(), each, strict=True))
    priors, control = [], []
    pose = "EDGE_PRIOR_SE2" if d == 2 else "EDGE_SE3_PRIOR"
    for frame, at, rows, n in _each(lines, pose, ids, offsets, d):
        M = motions(rows.only(n), d, lines.path)[0]
        W = _full(rows.values[n, 3 if d == 2 else 7 :])
        if not W[d:].any():  # of the position alone
            W = M[:d, :d] @ W[:d, :d] @ M[:d, :d].T
            control.append((frame, at[:d, d], M[:d, d], W))
            continue
        turn = np.asarray(lie.adjoint(jnp.asarray(np.linalg.inv(at))), np.float64)
        priors.append((frame, M @ np.linalg.inv(at), turn.T @ W @ turn))
    place = "EDGE_PRIOR_SE2_XY" if d == 2 else "EDGE_SE3_XYZPRIOR"
    for frame, at, rows, n in _each(lines, place, ids, offsets, d):
        x = rows.values[n]
        control.append((frame, at[:d, d], x[:d], _full(x[d:])))
    return KnownOfGraph(priors, _fixed(lines, ids, vertices, d), control)


def _each(
    lines: Lines, tag: str, ids: np.ndarray, offsets: dict[int, np.ndarray], d: int
) -> list[tuple[int, np.ndarray, Rows, int]]:
    """Frame and sensor of each line of a kind, and where its numbers are."""
    rows = lines.rows(tag, *KNOWN[tag])
    out = []
    for n, (line, own) in enumerate(zip(rows.line, rows.ids.tolist(), strict=True)):
        frame = int(np.searchsorted(ids, own[0]))
        if frame == len(ids) or ids[frame] != own[0]:
            raise InputError(
                f"{lines.path}, line {line}: no vertex or edge of {own[0]}."
            )
        offset = np.eye(d + 1)
        if d == 3:
            # Files of other programs leave out the one that says nothing.
            found = offsets.get(own[1], offset if own[1] == 0 else None)
            if found is None:
                raise InputError(
                    f"{lines.path}, line {line}: no PARAMS_SE3OFFSET {own[1]}."
                )
            offset = found
        out.append((frame, offset, rows, n))
    return out


def _fixed(
    lines: Lines, ids: np.ndarray, vertices: Rows, d: int
) -> list[tuple[int, np.ndarray]]:
    """FIX lines of vertices that have a pose; of the others nothing is known."""
    poses = motions(vertices, d, lines.path)
    at = {name: T for name, T in zip(vertices.ids[:, 0].tolist(), poses, strict=True)}
    out = {}
    for line, words in lines.found["FIX"]:
        for word in words:
            if not word.isdecimal():
                raise InputError(f"{lines.path}, line {line}: {word!r} is no id.")
            if int(word) in at:
                frame = int(np.searchsorted(ids, int(word)))
                out[frame] = at[int(word)]
    return list(out.items())


def known_lines(
    known: KnownOfGraph, names: np.ndarray, d: int, digits: int
) -> list[str]:
    """The lines to write; `names` are the ids of the frames."""
    out, offsets = [], [np.zeros(3)]
    for n, (frame, T, *info) in enumerate(known.priors):
        check_rigid(np.asarray(T), f"known.priors[{n}]")
        own = (int(names[frame]),) if d == 2 else (int(names[frame]), 0)
        tag = "EDGE_PRIOR_SE2" if d == 2 else "EDGE_SE3_PRIOR"
        values = [columns(np.asarray(T)[None])[0], _upper(info, lie.tangent_dim(d))]
        out += _line(tag, own, values, digits)
    for n, (frame, p, q, *info) in enumerate(known.control):
        p = np.asarray(p, np.float64)
        if d == 2 and p.any():
            raise ValueError(
                f"known.control[{n}]: g2o has no line of a point beside a frame in 2D."
            )
        own = (int(names[frame]),) if d == 2 else (int(names[frame]), len(offsets))
        tag = "EDGE_PRIOR_SE2_XY" if d == 2 else "EDGE_SE3_XYZPRIOR"
        out += _line(tag, own, [np.asarray(q, np.float64), _upper(info, d)], digits)
        offsets.append(p)
    if d == 3 and (known.priors or known.control):
        quiet = np.array([0.0, 0, 0, 1])
        head = [
            _line("PARAMS_SE3OFFSET", (n,), [p, quiet], digits)[0]
            for n, p in enumerate(offsets)
        ]
        out = head + out
    fixed = [f"FIX {names[frame]}" for frame, _ in known.fixed]
    return out + fixed


def _line(
    tag: str, own: Sequence[int], values: list[np.ndarray], digits: int
) -> list[str]:
    return lines_of(tag, np.array([own]), np.concatenate(values)[None], digits)


def _upper(info: Sequence[Any], k: int) -> np.ndarray:
    W = np.eye(k) if not info or info[0] is None else np.asarray(info[0], np.float64)
    return W[np.triu_indices(k)]


def _full(upper: np.ndarray) -> np.ndarray:
    k = int(np.sqrt(2 * len(upper)))
    out = np.zeros((k, k))
    out[np.triu_indices(k)] = upper
    return out + np.triu(out, 1).T
