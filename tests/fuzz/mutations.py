"""Ways to damage a file, each from a generator of random numbers."""

import gzip
import re
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np


WORDS = [
    b"nan",
    b"inf",
    b"-inf",
    b"1e999",
    b"9" * 400,
    b"word",
    b"",
    b"-1",
    b"0",
    b"1_0",
]
WORDS += [b"4294967295", b"9223372036854775808", b"1e308", b"0x1F", b"1,5", b"\xff\xfe"]
SUFFIXES = (".ply", ".xyz", ".csv", ".pts", ".pcd", ".las", ".laz", ".e57", ".obj")
SUFFIXES += (".stl", ".npy", ".npz", ".xyz.gz", ".ply.gz", ".g2o", ".zip", "")
_NUMBER = re.compile(rb"(?<![\w.])[-+]?\d+(?:\.\d+)?(?:[eE][-+]?\d+)?(?![\w.])")
_COUNT = re.compile(
    rb"(element \w+ |POINTS |WIDTH |HEIGHT |COUNT |SIZE |\A|'shape': \()(\d+)(?=[\s,])"
)


@dataclass(frozen=True)
class Damaged:
    """A damaged file; `seen`: whether the damage must not pass unnoticed."""

    name: str
    data: bytes
    how: str
    seen: bool = False


def cut(rng: np.random.Generator, name: str, data: bytes) -> Damaged:
    """The file ends early."""
    return Damaged(name, data[: rng.integers(0, len(data))], "cut", True)


def cut_text(rng: np.random.Generator, name: str, data: bytes) -> Damaged:
    """Whole lines at the end are gone."""
    lines = data.splitlines(keepends=True)
    kept = rng.integers(0, len(lines) + 1)
    return Damaged(name, b"".join(lines[:kept]), "lines cut", True)


def flip(rng: np.random.Generator, name: str, data: bytes) -> Damaged:
    """Some bytes are others, more often near the beginning."""
    out = bytearray(data)
    for _ in range(rng.integers(1, 9)):
        at = int(len(out) * rng.random() ** rng.integers(1, 4))
        out[at] = rng.choice(np.array([0, 255, 10, 32, 45, rng.integers(256)]))
    return Damaged(name, bytes(out), "bytes flipped")


def integer(rng: np.random.Generator, name: str, data: bytes) -> Damaged:
    """A binary number of the first 400 bytes is huge, negative or zero."""
    out = bytearray(data)
    size = int(rng.choice([2, 4, 8]))
    at = int(rng.integers(0, max(1, min(len(out), 400) - size)))
    value = int(rng.choice([0, 1, 2**31 - 1, 2**31, 2**32 - 1, 10**9]))
    out[at : at + size] = (value % 2 ** (8 * size)).to_bytes(size, "little")
    return Damaged(name, bytes(out), "binary number replaced")


def count(rng: np.random.Generator, name: str, data: bytes) -> Damaged:
    """A count of the header is another."""
    found = list(_COUNT.finditer(data[:1000]))
    if not found:
        return cut(rng, name, data)
    match = found[rng.integers(len(found))]
    old = int(match[2])
    value = rng.choice([old + 1, max(old - 1, 0), 0, 10**9, 10**15, 2 * old])
    new = data[: match.start(2)] + str(value).encode() + data[match.end(2) :]
    return Damaged(name, new, "count changed", int(value) != old)


def word(rng: np.random.Generator, name: str, data: bytes) -> Damaged:
    """A number in text is nan, huge, a word or nothing."""
    found = list(_NUMBER.finditer(data))
    if not found:
        return flip(rng, name, data)
    match = found[rng.integers(len(found))]
    new = data[: match.start()] + WORDS[rng.integers(len(WORDS))] + data[match.end() :]
    return Damaged(name, new, "number replaced")


def line(rng: np.random.Generator, name: str, data: bytes) -> Damaged:
    """A line is there twice, away, or in another place."""
    lines = data.splitlines(keepends=True)
    k, m = rng.integers(len(lines), size=2)
    chosen = lines[k]
    if rng.random() < 0.5:
        del lines[k]
    for _ in range(rng.integers(0, 3)):
        lines.insert(m, chosen)
    return Damaged(name, b"".join(lines), "lines moved")


def endian(rng: np.random.Generator, name: str, data: bytes) -> Damaged:
    """The bytes of the second half stand in another order."""
    start = int(rng.integers(0, len(data)))
    body = data[start : start + (len(data) - start) // 4 * 4]
    turned = np.frombuffer(body, "<u4").byteswap().tobytes()
    swapped = data.replace(b"little_endian", b"big_endian").replace(b"<f", b">f")
    if swapped != data and rng.random() < 0.5:
        return Damaged(name, swapped, "wrong byte order said")
    return Damaged(name, data[:start] + turned + data[start + len(body) :], "swapped")


def other(rng: np.random.Generator, name: str, data: bytes) -> Damaged:
    """The suffix is wrong, or the file empty, packed, packed twice, or noise."""
    stem = name.split(".")[0]
    kind = rng.integers(6)
    if kind == 0:
        return Damaged(stem + SUFFIXES[rng.integers(len(SUFFIXES))], data, "renamed")
    if kind == 1:
        return Damaged(name, b"", "empty")
    if kind == 2:
        return Damaged(name, gzip.compress(data), "packed")
    if kind == 3:
        return Damaged(name, rng.bytes(int(rng.integers(1, 3000))), "noise")
    if kind == 4:
        return Damaged(name, data + data, "twice")
    new = data.replace(b"\n", rng.choice([b"\r", b"\r\n", b"\n\n", b"\0", b" "]))
    return Damaged(name, new, "line ends")


def inner(rng: np.random.Generator, name: str, data: bytes) -> Damaged:
    """What a packed file holds is damaged."""
    plain = gzip.decompress(data)
    choice = CHOICES[rng.integers(len(CHOICES))]
    found = choice(rng, name.removesuffix(".gz"), plain)
    packed = gzip.compress(found.data, mtime=0)
    counted = not name.endswith((".xyz.gz", ".g2o.gz"))
    return Damaged(name, packed, f"inside {found.how}", found.seen and counted)


CHOICES: list[Callable[[np.random.Generator, str, bytes], Damaged]] = [
    cut,
    cut_text,
    flip,
    integer,
    count,
    word,
    line,
    endian,
    other,
]


def damaged(rng: np.random.Generator, name: str, data: bytes) -> Damaged:
    """One of them."""
    if name.endswith(".gz") and rng.random() < 0.6:
        return inner(rng, name, data)
    return CHOICES[rng.integers(len(CHOICES))](rng, name, data)
