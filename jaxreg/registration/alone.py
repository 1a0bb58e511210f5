"""One pair: of padded sizes, and a search as two programs."""

import equinox as eqx
import jax
from jaxtyping import Array

from jaxreg._core.checks import is_concrete
from jaxreg._core.programs import kept_program
from jaxreg._core.programs_in_a_row import kept_programs
from jaxreg._core.typing import Scalar
from jaxreg.batching.devices import Devices, for_one, map_rows, spread_rows
from jaxreg.batching.padding import lengthened, rounded_up
from jaxreg.neighbours import AbstractIndex
from jaxreg.particle import AbstractSearch
from jaxreg.particle.candidates import Candidates
from jaxreg.particle.pair import Pair
from jaxreg.registrar import (
    AbstractRegistrar,
    GivenPair,
    PreparedPair,
    RegistrationSolution,
)
from jaxreg.registration.pair import enter_pair, leave_pair, register_pair


# A pair; an initial pose; a key.
_Given = tuple[GivenPair, Array | None, Array | None]


def register_alone(
    method: AbstractRegistrar,
    pair: GivenPair,
    init: Array | None,
    key: Array | None,
    devices: Devices | None,
) -> RegistrationSolution:
    """On one device, or with its particles spread over several."""
    devices = for_one(devices)
    given = spread_rows(devices, (_rounded_up(pair), init, key))
    if devices is None and isinstance(method, AbstractSearch):
        if all(map(is_concrete, jax.tree.leaves((method, given)))):
            return _register_in_two(method, *given)
    return _register_at_once(method, given, devices)


def _rounded_up(pair: GivenPair) -> GivenPair:
    """With masked rows added to concrete arrays, so that few sizes compile.

    Both get one size where these are next to each other: else pairs of scans of similar
    sizes would be four programs.
    """
    clouds = pair[:4]
    if not all(map(is_concrete, clouds)):
        return pair
    sizes = [rounded_up(len(x), an_octave=2) for x in clouds[:2]]
    if max(sizes) <= 1.5 * min(sizes):
        sizes = [max(sizes)] * 2
    longer = (lengthened(x, num) for x, num in zip(clouds, 2 * sizes, strict=True))
    return GivenPair(*longer, viewpoints=pair.viewpoints)


@kept_program
def _register_at_once(
    method: AbstractRegistrar, given: _Given, devices: Devices | None
) -> RegistrationSolution:
    if devices is None:
        return register_pair(method, *given)
    return map_rows(devices, lambda given: register_pair(method, *given), given)


class _Searched(eqx.Module):
    """What `_conclude` needs of what was given and found."""

    ready: PreparedPair
    target_index: AbstractIndex
    spacings: tuple[Scalar, Scalar]
    candidates: Candidates


def _search(
    method: AbstractSearch, given: GivenPair, init: Array | None, key: Array | None
) -> _Searched:
    ready, init = enter_pair(method, given, init)
    search = ready.method
    assert isinstance(search, AbstractSearch)
    pair = Pair.of(ready.source, ready.target, search.index_of(ready.target))
    candidates = search.candidates(pair, init, key)
    return _Searched(ready, pair.target_index, pair.spacings, candidates)


def _conclude(given: _Searched) -> RegistrationSolution:
    ready, search = given.ready, given.ready.method
    assert isinstance(search, AbstractSearch)
    pair = Pair(ready.source, ready.target, given.target_index, given.spacings)
    return leave_pair(ready, search.concluded(pair, given.candidates))


_register_in_two = kept_programs(_search, _conclude)
