"""Cases of damaged files: what is read, and how that ended."""

import traceback
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from jaxreg.io import InputError, MissingExtraError
from tests.fuzz.mutations import Damaged, damaged
from tests.fuzz.samples import Sample, samples


@dataclass(frozen=True)
class DamagedSample:
    """A valid file and what became of it."""

    sample: Sample
    made: Damaged


def file_case(found: list[Sample], seed: int, number: int) -> DamagedSample:
    """The damaged file of a number; its kind goes around."""
    rng = np.random.default_rng([seed, number])
    sample = found[number % len(found)]
    return DamagedSample(sample, damaged(rng, sample.name, sample.data))


class FileCases:
    """All of them, by number; in the working folder."""

    def __init__(self) -> None:
        self.samples = samples()
        self.whole = {}
        for sample in self.samples:
            Path(sample.name).write_bytes(sample.data)
            self.whole[sample.name] = sample.read(Path(sample.name))

    def make(self, seed: int, number: int) -> DamagedSample:
        """The damaged file of a number."""
        return file_case(self.samples, seed, number)

    def words(self, case: DamagedSample) -> tuple[str, str]:
        """Which file, and what became of it."""
        return case.sample.name, case.made.how

    def run(self, case: DamagedSample) -> str:
        """How reading it ended: read, refused, or what is wrong with the end."""
        path = Path(f"case-{case.made.name}")
        path.write_bytes(case.made.data)
        try:
            return self._outcome(path, case)
        finally:
            path.unlink()

    def _outcome(self, path: Path, case: DamagedSample) -> str:
        sample = case.sample
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
        whole = self.whole[sample.name]
        if sample.counted and case.made.seen and not _same(arrays, whole):
            return "silent"
        if not arrays or not all(len(a) for a in arrays):
            return "silent"
        return "read"


def _same(one: list[np.ndarray], other: list[np.ndarray]) -> bool:
    return len(one) == len(other) and all(
        a.shape == b.shape and np.allclose(a, b, 1e-5, equal_nan=True)
        for a, b in zip(one, other, strict=True)
    )
