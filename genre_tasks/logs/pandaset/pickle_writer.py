"""Writes a table of numbers and strings as the pickle of a pandas DataFrame, without pandas.

The same structure as PandaSet's own files (protocol 3, a block manager with state "0.14.1"), which pandas reads from
0.25 to 3. The same table gives the same bytes, on any machine.
"""

from __future__ import annotations

import struct
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class _Name:
    """A global: module and name."""

    module: str
    name: str


@dataclass(frozen=True)
class _Made:
    """``function(*args)``, with a state if there is one; ``new`` for ``cls.__new__``."""

    function: _Name
    args: tuple[Any, ...]
    state: Any = None
    new: bool = False


_INDEX = _Name("pandas.core.indexes.base", "Index")
_RANGE_INDEX = _Name("pandas.core.indexes.range", "RangeIndex")
_NEW_INDEX = _Name("pandas.core.indexes.base", "_new_Index")
_RECONSTRUCT = _Name("numpy.core.multiarray", "_reconstruct")
_NDARRAY = _Name("numpy", "ndarray")
_DTYPE = _Name("numpy", "dtype")


def pickle_frame(columns: Mapping[str, NDArray[Any]]) -> bytes:
    """The pickle of a DataFrame with these columns and rows numbered from 0.

    Args:
        columns: name → [N] of float64, int64, bool, or object (str, float, None), all of one length; at least one.

    Raises:
        ValueError: no columns, columns of different lengths, or a dtype that is none of these.
    """
    lengths = {len(values) for values in columns.values()}
    if len(lengths) != 1 or any(values.ndim != 1 for values in columns.values()):
        raise ValueError(f"expected columns of one length, got lengths {sorted(lengths)}")
    blocks = []
    for dtype in dict.fromkeys(values.dtype for values in columns.values()):
        places = [at for at, values in enumerate(columns.values()) if values.dtype == dtype]
        block = np.stack([values for values in columns.values() if values.dtype == dtype])
        blocks.append({"values": _array(block), "mgr_locs": _array(np.array(places, dtype=np.int64))})
    names = _Made(_NEW_INDEX, (_INDEX, {"data": _array(np.array(list(columns), dtype=object)), "name": None}))
    extent = {"name": None, "start": 0, "stop": lengths.pop(), "step": 1}
    axes = [names, _Made(_NEW_INDEX, (_RANGE_INDEX, extent))]
    # The first three entries are what pandas before 0.14.1 read; nothing reads them any more.
    state: tuple[Any, ...] = ([], [], [], {"0.14.1": {"axes": axes, "blocks": blocks}})
    manager = _Made(_Name("pandas.core.internals.managers", "BlockManager"), (), state, new=True)
    frame = {"_data": manager, "_typ": "dataframe", "_metadata": []}
    return b"\x80\x03" + _emit(_Made(_Name("pandas.core.frame", "DataFrame"), (), frame, new=True)) + b"."


def _array(values: NDArray[Any]) -> _Made:
    code = {"float64": "f8", "int64": "i8", "bool": "b1", "object": "O8"}.get(str(values.dtype))
    if code is None:
        raise ValueError(f"expected float64, int64, bool or object, got {values.dtype}")
    swapped = "|" if code in ("b1", "O8") else "<"
    flags = 63 if code == "O8" else 0  # numpy's item flags of objects
    dtype = _Made(_DTYPE, (code, False, True), (3, swapped, None, None, None, -1, -1, flags))
    data = values.ravel().tolist() if code == "O8" else values.astype(f"{swapped}{code}").tobytes()
    return _Made(_RECONSTRUCT, (_NDARRAY, (0,), b"b"), (1, values.shape, dtype, False, data))


def _emit(value: Any) -> bytes:
    """The opcodes that put a value on the unpickler's stack (see ``pickletools`` for their names)."""
    if value is None:
        return b"N"
    if value is True or value is False:
        return b"\x88" if value else b"\x89"
    if isinstance(value, int):
        return b"J" + struct.pack("<i", value)
    if isinstance(value, float):
        return b"G" + struct.pack(">d", value)
    if isinstance(value, str):
        data = value.encode()
        return b"X" + struct.pack("<I", len(data)) + data
    if isinstance(value, bytes):
        return b"B" + struct.pack("<I", len(value)) + value
    if isinstance(value, tuple):
        return b"(" + b"".join(map(_emit, value)) + b"t"
    if isinstance(value, list):
        return b"](" + b"".join(map(_emit, value)) + b"e"
    if isinstance(value, dict):
        return b"}(" + b"".join(_emit(key) + _emit(item) for key, item in value.items()) + b"u"
    if isinstance(value, _Name):
        return f"c{value.module}\n{value.name}\n".encode()
    if isinstance(value, _Made):
        made = _emit(value.function) + _emit(value.args) + (b"\x81" if value.new else b"R")
        return made if value.state is None else made + _emit(value.state) + b"b"
    raise ValueError(f"a cell must be a number, text or None, got {type(value).__name__}")
