"""Cases of bad arguments: what is called with what, and how that ended."""

import dataclasses
import traceback
from pathlib import Path
from typing import Any

import jax
import numpy as np

import jaxreg
from jaxreg.io import MissingExtraError
from tests.fuzz.arguments import spoiled
from tests.fuzz.calls import Call, calls


PACKAGE = Path(jaxreg.__file__).parent


@dataclasses.dataclass(frozen=True)
class SpoiledCall:
    """A call with one bad argument, seldom two."""

    call: Call
    arguments: dict[str, Any]
    how: str


class CallCases:
    """All of them, by number; those that compile little if not `dear`."""

    def __init__(self, dear: bool = True) -> None:
        # Compiling is what it costs.
        jax.config.update("jax_disable_most_optimizations", True)
        self.calls = calls(dear)
        self._tried: set[str] = set()

    def make(self, seed: int, number: int) -> SpoiledCall:
        """The call of a number; what is called goes around."""
        rng = np.random.default_rng([seed, number])
        call = self.calls[number % len(self.calls)]
        self._try(call)
        count = min(1 + (rng.random() < 0.1), len(call.arguments))
        names = rng.choice(list(call.arguments), count, replace=False).tolist()
        changed = {name: spoiled(rng, name, call.arguments[name]) for name in names}
        values = {name: value for name, (_, value) in changed.items()}
        how = ", ".join(f"{name}: {how}" for name, (how, _) in changed.items())
        return SpoiledCall(call, {**call.arguments, **values}, how)

    def _try(self, call: Call) -> None:
        """Requires that it ends well when nothing is spoiled; compiles its program."""
        if call.name not in self._tried:
            wrong = call.wrong(call.function(**call.arguments))
            if wrong is not None:
                raise RuntimeError(f"{call.name}: {wrong}")
            self._tried.add(call.name)

    def words(self, case: SpoiledCall) -> tuple[str, str]:
        """What is called, and with what."""
        return case.call.name, case.how

    def run(self, case: SpoiledCall) -> str:
        """How the call ended: answered, refused, or what is wrong with the end."""
        try:
            answer = case.call.function(**case.arguments)
            wrong = case.call.wrong(answer)
        except (ValueError, TypeError, MissingExtraError) as err:
            return _judged(err, list(case.arguments))
        except BaseException as err:
            if isinstance(err, MemoryError) or "RESOURCE_EXHAUSTED" in str(err):
                return "over memory"
            return "traceback: " + traceback.format_exc(limit=-3)
        return "answered" if wrong is None else f"silent: {wrong}"


def _judged(err: Exception, names: list[str]) -> str:
    """Whether an error is one message of the package that names the argument."""
    frames = traceback.extract_tb(err.__traceback__)
    message = str(err)
    if PACKAGE not in Path(frames[-1].filename).parents:
        return "traceback: " + "".join(traceback.format_exception(err, limit=-2))
    # What does not fit together may be told of either; of one row in the singular.
    if not any(name.rstrip("s") in message for name in names):
        return f"traceback: names no argument: {message}"
    if len(message.splitlines()) > 2:
        return f"traceback: no message of two lines: {message}"
    return "refused"
