"""What a file is by its first bytes, against what its name says."""

from pathlib import Path

from jaxreg.io.errors import InputError


# First bytes, the kind, and the suffixes that promise it.
_KINDS = (
    (b"ply\n", "a PLY", (".ply",)),
    (b"ply\r", "a PLY", (".ply",)),
    (b"# .PCD", "a PCD", (".pcd",)),
    (b"LASF", "a LAS", (".las", ".laz")),
    (b"ASTM-E57", "an E57", (".e57",)),
    (b"\x93NUMPY", "an NPY", (".npy",)),
    (b"PK\x03\x04", "an NPZ or ZIP", (".npz",)),
    (b"\x1f\x8b", "a gzip", ()),
)


def require_suffix(data: bytes, suffix: str, path: Path) -> None:
    """Refuses data that are plainly of another kind than the suffix says.

    Raises:
        InputError: that names the kind and the suffix that fits.
    """
    for start, kind, suffixes in _KINDS:
        if data.startswith(start) and suffix not in suffixes:
            packed = ".gz" if path.name.lower().endswith(".gz") else ""
            wanted = suffixes[0] + packed if suffixes else f"{suffix}.gz"
            if packed and not suffixes:
                raise InputError(
                    f"{path}: is compressed twice.\nUnpack it once, or both times."
                )
            raise InputError(
                f"{path}: {kind} file by its content, whatever its name says.\n"
                f"Rename it to end in {wanted}."
            )
