"""E57: the pose of each scan in the file changes, all else is copied node by node.

By hand: pye57 writes only the fields that it knows, of a whole scan at a time.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from jaxreg.io.errors import InputError
from jaxreg.io.extras import require
from jaxreg.io.moved.motion import Moving
from jaxreg.io.points.e57 import scan_names
from jaxreg.io.quaternions import motions_from_xyzw, xyzw_from_rotations


_CHUNK = 500_000  # points that are in memory at a time
_KINDS = {
    "STRUCTURE": "StructureNode",
    "VECTOR": "VectorNode",
    "COMPRESSED_VECTOR": "CompressedVectorNode",
    "INTEGER": "IntegerNode",
    "SCALED_INTEGER": "ScaledIntegerNode",
    "FLOAT": "FloatNode",
    "STRING": "StringNode",
    "BLOB": "BlobNode",
}


def move_e57(path: Path, out: Path, motions: Mapping[str, Moving]) -> None:
    """Writes the scans that have a motion again, with every field and image.

    Points stay as they are stored: the motion goes into the pose, of which the standard
    says that it takes them to the frame of the file.

    Raises:
        InputError: for a motion with scale, which a pose has not.
    """
    pye57 = require("pye57", "Writing E57")
    if any(abs(m.scale - 1) > 1e-6 for m in motions.values()):
        raise InputError(
            f"{path}: poses of E57 have no scale.\nExport the scans as PLY or LAS."
        )
    with pye57.E57(str(path)) as old, pye57.E57(str(out), mode="w") as new:
        copying = _Copying(pye57.libe57, old.image_file, new.image_file)
        copying.extensions()
        names = scan_names(old)
        root = old.image_file.root()
        target = new.image_file.root()
        for node in copying.children(root):
            name = node.elementName()
            if name == "data3D":
                for k, scan in enumerate(copying.children(node)):
                    if names[k] in motions:
                        # A compressed vector is filled when it hangs in the tree.
                        made = pye57.libe57.StructureNode(new.image_file)
                        target["data3D"].append(made)
                        copying.fill(made, scan, skip=("pose",))
                        made.set("pose", copying.pose(scan, motions[names[k]]))
            elif name == "images2D":
                copying.fill(target[name], node)
            elif not target.isDefined(name):
                copying.into(target, name, node)


class _Copying:
    """Nodes of one file made again in another."""

    def __init__(self, lib: Any, source: Any, target: Any):
        self.lib, self.source, self.target = lib, source, target
        self._classes = {
            getattr(lib, f"E57_{kind}"): getattr(lib, name)
            for kind, name in _KINDS.items()
        }

    def children(self, node: Any) -> list[Any]:
        """Of a structure or a vector, each as what it is."""
        found = [node.get(k) for k in range(node.childCount())]
        return [
            self._classes[x.type()](x) if isinstance(x, self.lib.Node) else x
            for x in found
        ]

    def extensions(self) -> None:
        for k in range(self.source.extensionsCount()):
            prefix = self.source.extensionsPrefix(k)
            uri = self.source.extensionsUri(k)
            if prefix and not self.target.extensionsLookupPrefix(prefix):
                self.target.extensionsAdd(prefix, uri)

    def fill(self, target: Any, source: Any, skip: tuple[str, ...] = ()) -> None:
        for node in self.children(source):
            if node.elementName() not in skip:
                self.into(target, node.elementName(), node)

    def into(self, parent: Any, name: str, node: Any) -> None:
        """Hangs a copy under this name, or behind the others of a vector."""
        lib = self.lib

        def hang(made: Any) -> Any:
            vector = isinstance(parent, lib.VectorNode)
            parent.append(made) if vector else parent.set(name, made)
            return made

        if isinstance(node, lib.StructureNode):
            self.fill(hang(lib.StructureNode(self.target)), node)
        elif isinstance(node, lib.VectorNode):
            mixed = node.allowHeteroChildren()
            self.fill(hang(lib.VectorNode(self.target, mixed)), node)
        elif isinstance(node, lib.CompressedVectorNode):
            self._points(hang, node)
        elif isinstance(node, lib.BlobNode):
            made = hang(lib.BlobNode(self.target, node.byteCount()))
            data = np.zeros(node.byteCount(), np.uint8)
            node.read(data, 0, node.byteCount())
            made.write(data, 0, node.byteCount())
        else:
            hang(self._number(node))

    def _number(self, node: Any) -> Any:
        lib = self.lib
        if isinstance(node, lib.StringNode):
            return lib.StringNode(self.target, node.value())
        ends = node.minimum(), node.maximum()
        if isinstance(node, lib.FloatNode):
            return lib.FloatNode(self.target, node.value(), node.precision(), *ends)
        if isinstance(node, lib.IntegerNode):
            return lib.IntegerNode(self.target, node.value(), *ends)
        scale = node.scale(), node.offset()
        return lib.ScaledIntegerNode(self.target, node.rawValue(), *ends, *scale)

    def _points(self, hang: Any, node: Any) -> None:
        lib = self.lib
        prototype = lib.StructureNode(self.target)
        kinds: dict[str, str] = {}
        for field in self.children(lib.StructureNode(node.prototype())):
            prototype.set(field.elementName(), self._number(field))
            real = isinstance(field, lib.FloatNode)
            kinds[field.elementName()] = "d" if real else "q"
        codecs = lib.VectorNode(self.target, True)
        made = hang(lib.CompressedVectorNode(self.target, prototype, codecs))
        data = {name: np.zeros(_CHUNK, kind) for name, kind in kinds.items()}
        reader = node.reader(self._buffers(self.source, data))
        writer = made.writer(self._buffers(self.target, data))
        while count := reader.read():
            writer.write(count)
        reader.close()
        writer.close()

    def _buffers(self, file: Any, data: dict[str, np.ndarray]) -> Any:
        """Floats as float64, integers and scaled ones as they are stored."""
        out = self.lib.VectorSourceDestBuffer()
        for name, column in data.items():
            out.append(
                self.lib.SourceDestBuffer(
                    file, name, column, len(column), column.dtype.kind == "f", False
                )
            )
        return out

    def pose(self, scan: Any, moving: Moving) -> Any:
        """The pose of a scan, moved."""
        T = np.eye(4)
        if scan.isDefined("pose"):
            parts = {x.elementName(): x for x in self.children(scan["pose"])}
            old = {k: self._numbers(part) for k, part in parts.items()}
            turn, shift = old.get("rotation", {}), old.get("translation", {})
            w, x, y, z = (turn.get(a, float(a == "w")) for a in "wxyz")
            t = [shift.get(a, 0.0) for a in "xyz"]
            T = motions_from_xyzw(np.array([t]), np.array([[x, y, z, w]]))[0]
        T = moving.T @ T
        x, y, z, w = xyzw_from_rotations(T[None, :3, :3])[0]
        made = self.lib.StructureNode(self.target)
        for part, values in (
            ("rotation", {"w": w, "x": x, "y": y, "z": z}),
            ("translation", dict(zip("xyz", T[:3, 3], strict=True))),
        ):
            group = self.lib.StructureNode(self.target)
            for axis, value in values.items():
                group.set(axis, self.lib.FloatNode(self.target, float(value)))
            made.set(part, group)
        return made

    def _numbers(self, part: Any) -> dict[str, float]:
        return {x.elementName(): float(x.value()) for x in self.children(part)}
