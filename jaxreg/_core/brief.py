"""Modules that say what they are in a line.

By hand: wadler_lindig shows every default that a converter has made an array, and
numbers in arrays by their dtype; its hooks for both would take as many lines.
"""

import dataclasses

import equinox as eqx
import jax
import numpy as np

from jaxreg._core.checks import is_concrete


_MAX_LENGTH = 170


class BriefModule(eqx.Module):
    """Its repr: the fields that differ from their defaults, arrays by their shape."""

    def __repr__(self) -> str:
        shown = [
            f"{field.name}={_brief(getattr(self, field.name))}"
            for field in dataclasses.fields(self)
            if not _is_default(field, getattr(self, field.name))
        ]
        while shown and sum(map(len, shown)) + 2 * len(shown) > _MAX_LENGTH:
            shown = [*shown[: -2 if shown[-1] == "..." else -1], "..."]
        return f"{type(self).__name__}({', '.join(shown)})"


def _is_default(field: "dataclasses.Field[object]", value: object) -> bool:
    default = field.default
    if field.default_factory is not dataclasses.MISSING:
        default = field.default_factory()
    if default is dataclasses.MISSING:
        return False
    return _brief(value) == _brief(default)


def _brief(value: object) -> str:
    if isinstance(value, jax.Array) and value.ndim == 0 and is_concrete(value):
        value = value.item()
    if isinstance(value, (float, np.floating)):
        return f"{value:.6g}"
    if eqx.is_array_like(value) and not isinstance(value, (bool, int, complex)):
        return eqx.tree_pformat(value)
    return repr(value)
