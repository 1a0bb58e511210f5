"""What builds an index: its class, or its class with options."""

import inspect
from typing import Any, TypeAlias

from jaxreg._core.checks import shown, told
from jaxreg._core.typing import Mask, Points
from jaxreg.neighbours.base import AbstractIndex


class IndexOptions:
    """A class of indexes with options of its `build`; equal ones compile once.

    Args:
        kind: an index class.
        options: keywords of its `build`, hashable.

    Raises: TypeError while constructing, for options that it does not have.
    """

    def __init__(self, kind: type[AbstractIndex], **options: Any) -> None:
        if not _is_index(kind):
            raise TypeError(
                "IndexOptions: kind: wanted the class of an index such as VoxelTable, "
                f"found {shown(kind)}."
            )
        known = list(inspect.signature(kind.build).parameters)[2:]
        for name in options:
            if name not in known:
                raise TypeError(
                    f"IndexOptions: {kind.__name__} has the options {known}, found "
                    f"{name!r}."
                )
        self._kind, self._options = kind, tuple(sorted(options.items()))

    def build(self, points: Points, mask: Mask | None = None) -> AbstractIndex:
        """That of the class, with the options."""
        return self._kind.build(points, mask, **dict(self._options))

    def __eq__(self, other: object) -> bool:
        return isinstance(other, IndexOptions) and self._key == other._key

    def __hash__(self) -> int:
        return hash(self._key)

    def __repr__(self) -> str:
        options = "".join(f", {name}={value!r}" for name, value in self._options)
        return f"IndexOptions({self._kind.__name__}{options})"

    @property
    def _key(self) -> tuple[object, ...]:
        return self._kind, self._options


#: What methods take as `index`, static.
IndexBuilder: TypeAlias = type[AbstractIndex] | IndexOptions


def check_index(method: object) -> None:
    """Requires that a method's `index` builds one, or is None."""
    found = getattr(method, "index")  # noqa: B009
    if found is None or isinstance(found, IndexOptions) or _is_index(found):
        return
    raise TypeError(
        f"{type(method).__name__}: index: wanted the class of an index such as "
        f"BruteForce, IndexOptions of one, or None, found {told(found, AbstractIndex)}."
    )


def _is_index(found: object) -> bool:
    return isinstance(found, type) and issubclass(found, AbstractIndex)
