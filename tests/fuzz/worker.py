"""Reads damaged files under limits of time and memory; a line of JSON for each."""

import argparse
import json
import os
import resource
import signal
import sys
import tempfile
import traceback
import warnings
from pathlib import Path

import numpy as np

from jaxreg.io import InputError, MissingExtraError
from tests.fuzz.mutations import Damaged, damaged
from tests.fuzz.samples import Sample, samples


SECONDS, MEMORY = 10, 1 << 30


def case(seed: int, number: int, found: list[Sample]) -> tuple[Sample, Damaged]:
    """The damaged file of a number; its kind goes around."""
    rng = np.random.default_rng([seed, number])
    sample = found[number % len(found)]
    return sample, damaged(rng, sample.name, sample.data)


def outcome(path: Path, sample: Sample, made: Damaged, whole: list[np.ndarray]) -> str:
    """How reading it ended: read, refused, or what is wrong with the end."""
    try:
        arrays = sample.read(path)
    except (InputError, MissingExtraError) as err:
        lines = str(err).splitlines()
        if "more memory than there is" in lines[0]:
            return "over memory"
        if len(lines) > 2 or path.name not in lines[0]:
            return f"traceback: no message of two lines: {lines}"
        return "refused"
    except MemoryError:
        return "over memory"
    except BaseException:
        return "traceback: " + traceback.format_exc(limit=-3)
    if sample.counted and made.seen and not _same(arrays, whole):
        return "silent"
    if not arrays or not all(len(a) for a in arrays):
        return "silent"
    return "read"


def _same(one: list[np.ndarray], other: list[np.ndarray]) -> bool:
    return len(one) == len(other) and all(
        a.shape == b.shape and np.allclose(a, b, 1e-5, equal_nan=True)
        for a, b in zip(one, other, strict=True)
    )


def main() -> None:
    """Runs the cases of a range."""
    parser = argparse.ArgumentParser()
    parser.add_argument("seed", type=int)
    parser.add_argument("start", type=int)
    parser.add_argument("stop", type=int)
    options = parser.parse_args()
    warnings.simplefilter("ignore")
    found = samples()
    with tempfile.TemporaryDirectory() as folder:
        os.chdir(folder)
        whole = {}
        for sample in found:
            Path(sample.name).write_bytes(sample.data)
            whole[sample.name] = sample.read(Path(sample.name))
        # Threads and libraries that are loaded by now take address space, not memory.
        pages = int(Path("/proc/self/statm").read_text().split()[0])
        limit = pages * resource.getpagesize() + MEMORY
        resource.setrlimit(resource.RLIMIT_AS, (limit, limit))
        for number in range(options.start, options.stop):
            sample, made = case(options.seed, number, found)
            _say({"case": number, "kind": sample.name, "how": made.how})
            path = Path(f"case-{made.name}")
            path.write_bytes(made.data)
            signal.setitimer(signal.ITIMER_REAL, SECONDS)
            end = outcome(path, sample, made, whole[sample.name])
            signal.setitimer(signal.ITIMER_REAL, 0)
            path.unlink()
            _say({"case": number, "end": end})


def _say(line: dict) -> None:
    sys.stdout.write(json.dumps(line) + "\n")
    sys.stdout.flush()


if __name__ == "__main__":
    main()
