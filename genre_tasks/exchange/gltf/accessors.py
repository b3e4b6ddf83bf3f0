"""Arrays of a glTF file: read within their bounds and within a budget of memory, and collected for writing."""

from __future__ import annotations

from collections.abc import Collection
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from genre_tasks.errors import InputError
from genre_tasks.exchange.gltf.binary_container import align
from genre_tasks.exchange.gltf.document import Accessor, Document, Sparse, pick
from genre_tasks.logs.types import Float32

BYTE = 5120
UNSIGNED_BYTE = 5121
SHORT = 5122
UNSIGNED_SHORT = 5123
UNSIGNED_INT = 5125
FLOAT = 5126

SMALL_BYTES = 64 << 20
"""A file may always take this much memory, however small it is."""

MOST_RATIO = 32
"""A larger file may take this many times its size: a byte may become a float, and nodes may share a mesh."""

_DTYPES = {BYTE: "<i1", UNSIGNED_BYTE: "<u1", SHORT: "<i2", UNSIGNED_SHORT: "<u2", UNSIGNED_INT: "<u4", FLOAT: "<f4"}
_WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4}
_TYPES = {width: name for name, width in _WIDTHS.items()}
_ARRAY_BUFFER = 34962
_REMEDY = "Export the file again, or check it with a glTF validator."


class AccessorReader:
    """Reads arrays of one file.

    Args:
        path: of the file, for errors.
        document: its JSON.
        binary: its binary part.

    Raises:
        InputError: the file refers to another file, or its buffer is longer than its binary part.
    """

    def __init__(self, path: Path, document: Document, binary: memoryview) -> None:
        for k, buffer in enumerate(document.buffers):
            if buffer.uri is not None or k:
                problem = "the file refers to data outside of its binary part"
                raise InputError(problem, remedy="Export it as one self-contained GLB file.", file=path)
            if buffer.byte_length > len(binary):
                problem = f"the file's buffer claims {buffer.byte_length} bytes, and {len(binary)} are there"
                raise InputError(problem, remedy=_REMEDY, file=path)
        self._path = path
        self._document = document
        self._binary = binary
        self._left = max(SMALL_BYTES, MOST_RATIO * len(binary))

    def charge(self, size: int) -> None:
        """Counts memory against the budget, before it is taken.

        Args:
            size: bytes.

        Raises:
            InputError: the file asks for far more than its size.
        """
        self._left -= size
        if self._left < 0:
            problem = "the file asks for far more memory than its size"
            raise InputError(problem, remedy="Export it without instances of meshes and empty arrays.", file=self._path)

    def count(self, index: int) -> int:
        """Gives the number of elements of an array.

        Args:
            index: of the accessor.

        Raises:
            InputError: there is no such accessor.
        """
        return pick(self._path, self._document.accessors, index, "accessor").count

    def read(self, index: int, width: int, allowed: Collection[tuple[int, bool]] | None = None) -> Float32:
        """Reads an array as floats.

        Args:
            index: of the accessor.
            width: numbers of an element, 1 to 4.
            allowed: component types, each with whether it is normalized; ``None``: all.

        Returns:
            [count, width] float32; normalized integers become −1 to 1 or 0 to 1.

        Raises:
            InputError: the array has another type, leaves its view, is not finite, or is over the memory's budget.
        """
        accessor = pick(self._path, self._document.accessors, index, "accessor")
        kind = (accessor.component_type, accessor.normalized)
        if accessor.type != _TYPES[width] or kind[0] not in _DTYPES or (allowed is not None and kind not in allowed):
            shown = f"{accessor.type[:8]} of component type {kind[0]}{' normalized' if kind[1] else ''}"
            raise InputError(f"accessor {index} has an unexpected type, {shown}", remedy=_REMEDY, file=self._path)
        self.charge(4 * width * accessor.count)
        stored = self._view_elements(accessor, index, width)
        values = np.zeros((accessor.count, width), np.float32) if stored is None else _to_float(stored, accessor)
        if accessor.sparse is not None:
            self._replace_sparse(values, accessor, accessor.sparse, index)
        if not np.isfinite(values).all():
            raise InputError(f"accessor {index} has values that are not finite", remedy=_REMEDY, file=self._path)
        return values

    def _view_elements(self, accessor: Accessor, index: int, width: int) -> NDArray[Any] | None:
        if accessor.buffer_view is None:
            return None
        dtype = np.dtype(_DTYPES[accessor.component_type])
        return self._view(accessor.buffer_view, accessor.byte_offset, accessor.count, width, dtype=dtype, index=index)

    def _view(
        self, view_index: int, offset: int, count: int, width: int, *, dtype: np.dtype[Any], index: int
    ) -> NDArray[Any]:
        """Elements [count, width] without a copy, after a check that all of them are in their view."""
        view = pick(self._path, self._document.buffer_views, view_index, "buffer view")
        buffer = pick(self._path, self._document.buffers, view.buffer, "buffer")
        element = width * dtype.itemsize
        stride = view.byte_stride or element
        end = offset + stride * (count - 1) + element
        if stride < element or end > view.byte_length or view.byte_offset + view.byte_length > buffer.byte_length:
            problem = f"accessor {index} reaches beyond its buffer"
            raise InputError(problem, remedy=_REMEDY, file=self._path)
        start = view.byte_offset + offset
        return np.ndarray((count, width), dtype, self._binary, start, (stride, dtype.itemsize))

    def _replace_sparse(self, values: Float32, accessor: Accessor, sparse: Sparse, index: int) -> None:
        if sparse.indices.component_type not in (UNSIGNED_BYTE, UNSIGNED_SHORT, UNSIGNED_INT):
            raise InputError(f"accessor {index} has no whole numbers as indices", remedy=_REMEDY, file=self._path)
        rows = self._view(
            sparse.indices.buffer_view,
            sparse.indices.byte_offset,
            sparse.count,
            1,
            dtype=np.dtype(_DTYPES[sparse.indices.component_type]),
            index=index,
        )[:, 0]
        if rows.max() >= accessor.count:
            raise InputError(f"accessor {index} replaces elements it does not have", remedy=_REMEDY, file=self._path)
        replaced = self._view(
            sparse.values.buffer_view,
            sparse.values.byte_offset,
            sparse.count,
            values.shape[1],
            dtype=np.dtype(_DTYPES[accessor.component_type]),
            index=index,
        )
        values[rows] = _to_float(replaced, accessor)


def _to_float(stored: NDArray[Any], accessor: Accessor) -> Float32:
    values = stored.astype(np.float32)
    if accessor.normalized and stored.dtype.kind in "iu":
        # Two numbers of a signed type stand for −1, so that 0 is exact.
        values = np.maximum(values / np.float32(np.iinfo(stored.dtype).max), np.float32(-1))
    return values


class BufferBuilder:
    """Collects arrays for the binary part of a file, and describes them.

    Attributes:
        accessors: JSON of the accessors.
        buffer_views: JSON of their views.
        arrays: their bytes, in order.
        byte_length: of the binary part.
    """

    def __init__(self) -> None:
        self.accessors: list[dict[str, Any]] = []
        self.buffer_views: list[dict[str, Any]] = []
        self.arrays: list[memoryview] = []
        self.byte_length = 0

    def add(self, values: NDArray[Any], *, of_vertices: bool, bounds: bool = False) -> int:
        """Adds an array.

        Args:
            values: [count, width] float32, or uint8 for numbers from 0 to 1.
            of_vertices: whether a primitive uses it; else an animation does.
            bounds: whether smallest and largest values are stated, as glTF asks of positions and times.

        Returns:
            Index of the accessor.
        """
        packed = np.ascontiguousarray(values)
        view: dict[str, Any] = {"buffer": 0, "byteOffset": self.byte_length, "byteLength": packed.nbytes}
        if of_vertices:
            view["target"] = _ARRAY_BUFFER
        accessor: dict[str, Any] = {
            "bufferView": len(self.buffer_views),
            "componentType": FLOAT if packed.dtype == np.float32 else UNSIGNED_BYTE,
            "count": len(packed),
            "type": _TYPES[packed.shape[1]],
        }
        if packed.dtype != np.float32:
            accessor["normalized"] = True
        if bounds:
            accessor["min"] = packed.min(0).tolist()
            accessor["max"] = packed.max(0).tolist()
        self.buffer_views.append(view)
        self.accessors.append(accessor)
        self.arrays.append(packed.data.cast("B"))
        self.byte_length += align(packed.nbytes)
        return len(self.accessors) - 1
