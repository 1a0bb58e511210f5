"""What the columns of a file are by their names: normals, colours."""

from collections.abc import Sequence


# As PLY, PCD, LAS and E57 call them, in lower case.
NORMALS = (
    ("nx", "ny", "nz"),
    ("normal_x", "normal_y", "normal_z"),
    ("normalx", "normaly", "normalz"),
    ("nor:normalx", "nor:normaly", "nor:normalz"),
)
COLORS = (
    ("red", "green", "blue"),
    ("r", "g", "b"),
    ("rgb",),
    ("rgba",),
    ("colorred", "colorgreen", "colorblue"),
)


def named(
    fields: Sequence[str], kinds: Sequence[tuple[str, ...]]
) -> tuple[str, ...] | None:
    """The first of these groups that a file has, as it spells it; None without one."""
    spelled = {name.lower(): name for name in fields}
    for kind in kinds:
        if spelled.keys() >= set(kind):
            return tuple(spelled[name] for name in kind)
    return None
