"""Writes a table of numbers and strings as the pickle of a pandas DataFrame, without pandas.

The same structure as PandaSet's own files (protocol 3, a block manager with state "0.14.1"), which pandas reads from
0.25 to 3. The same table gives the same bytes, on any machine.
"""

from __future__ import annotations

import pickle
import struct
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

# The oldest protocol that has bytes, so that old versions of pandas read it too.
_PROTOCOL = b"\x03"
# Numpy's flags of an object dtype, as its own pickles state them.
_NUMPY_OBJECT_FLAGS = 63
_TYPE_CODES = {"float64": "f8", "int64": "i8", "bool": "b1", "object": "O8"}


@dataclass(frozen=True)
class _GlobalName:
    """A class or function that the pickle asks for."""

    module: str
    name: str


@dataclass(frozen=True)
class _CallNode:
    """What makes the unpickler call ``function(*args)`` and then set the state, if there is one."""

    function: _GlobalName
    args: tuple[Any, ...]
    state: Any = None


@dataclass(frozen=True)
class _NewNode(_CallNode):
    """The same, by ``function.__new__``."""


_INDEX = _GlobalName("pandas.core.indexes.base", "Index")
_RANGE_INDEX = _GlobalName("pandas.core.indexes.range", "RangeIndex")
_NEW_INDEX = _GlobalName("pandas.core.indexes.base", "_new_Index")
_BLOCK_MANAGER = _GlobalName("pandas.core.internals.managers", "BlockManager")
_DATA_FRAME = _GlobalName("pandas.core.frame", "DataFrame")
_RECONSTRUCT = _GlobalName("numpy.core.multiarray", "_reconstruct")
_NDARRAY = _GlobalName("numpy", "ndarray")
_DTYPE = _GlobalName("numpy", "dtype")


def pickle_table(columns: Mapping[str, NDArray[Any]]) -> bytes:
    """Pickles a DataFrame with these columns and rows numbered from 0.

    Args:
        columns: name → [N] of float64, int64, bool, or object (str, float, None), all of one length; at least one.

    Returns:
        The pickle, protocol 3.

    Raises:
        ValueError: no columns, columns of different lengths, or a dtype that is none of these.

    >>> from genre_tasks.logs.pandaset.pickle_reader import parse_table
    >>> parse_table(pickle_table({"label": np.array(["Car", None], dtype=object)})).columns["label"]
    array(['Car', None], dtype=object)
    """
    lengths = {len(values) for values in columns.values()}
    if len(lengths) != 1 or any(values.ndim != 1 for values in columns.values()):
        raise ValueError(f"expected columns of one length, got lengths {sorted(lengths)}")
    blocks = []
    # One block a dtype, in the order in which they first appear: the bytes follow from the table alone.
    for dtype in dict.fromkeys(values.dtype for values in columns.values()):
        indices = [index for index, values in enumerate(columns.values()) if values.dtype == dtype]
        block = np.stack([values for values in columns.values() if values.dtype == dtype])
        blocks.append({"values": _array_node(block), "mgr_locs": _array_node(np.array(indices, dtype=np.int64))})
    names = np.array(list(columns), dtype=object)
    column_index = _CallNode(_NEW_INDEX, (_INDEX, {"data": _array_node(names), "name": None}))
    row_range = {"name": None, "start": 0, "stop": lengths.pop(), "step": 1}
    axes = [column_index, _CallNode(_NEW_INDEX, (_RANGE_INDEX, row_range))]
    # The first three entries are what pandas before 0.14.1 read; nothing reads them any more.
    state: tuple[Any, ...] = ([], [], [], {"0.14.1": {"axes": axes, "blocks": blocks}})
    manager = _NewNode(_BLOCK_MANAGER, (), state)
    frame = _NewNode(_DATA_FRAME, (), {"_data": manager, "_typ": "dataframe", "_metadata": []})
    return pickle.PROTO + _PROTOCOL + _emit(frame) + pickle.STOP


def _array_node(values: NDArray[Any]) -> _CallNode:
    """The call that makes an array, as numpy writes it."""
    code = _TYPE_CODES.get(str(values.dtype))
    if code is None:
        raise ValueError(f"expected float64, int64, bool or object, got {values.dtype}")
    is_object = code == "O8"
    byte_order = "|" if code in ("b1", "O8") else "<"
    flags = _NUMPY_OBJECT_FLAGS if is_object else 0
    dtype = _CallNode(_DTYPE, (code, False, True), (3, byte_order, None, None, None, -1, -1, flags))
    data = values.ravel().tolist() if is_object else values.astype(f"{byte_order}{code}").tobytes()
    return _CallNode(_RECONSTRUCT, (_NDARRAY, (0,), b"b"), (1, values.shape, dtype, False, data))


def _emit(value: Any) -> bytes:
    """The opcodes that put a value on the unpickler's stack; ``pickle``'s constants are their bytes."""
    if value is None:
        return pickle.NONE
    # Before the integers, since a bool is one.
    if value is True or value is False:
        return pickle.NEWTRUE if value else pickle.NEWFALSE
    if isinstance(value, int):
        return pickle.BININT + struct.pack("<i", value)
    if isinstance(value, float):
        return pickle.BINFLOAT + struct.pack(">d", value)
    if isinstance(value, str):
        data = value.encode()
        return pickle.BINUNICODE + struct.pack("<I", len(data)) + data
    if isinstance(value, bytes):
        return pickle.BINBYTES + struct.pack("<I", len(value)) + value
    if isinstance(value, tuple):
        return pickle.MARK + b"".join(map(_emit, value)) + pickle.TUPLE
    if isinstance(value, list):
        return pickle.EMPTY_LIST + pickle.MARK + b"".join(map(_emit, value)) + pickle.APPENDS
    if isinstance(value, dict):
        items = b"".join(_emit(key) + _emit(item) for key, item in value.items())
        return pickle.EMPTY_DICT + pickle.MARK + items + pickle.SETITEMS
    if isinstance(value, _GlobalName):
        return pickle.GLOBAL + f"{value.module}\n{value.name}\n".encode()
    if isinstance(value, _CallNode):
        opcode = pickle.NEWOBJ if isinstance(value, _NewNode) else pickle.REDUCE
        call = _emit(value.function) + _emit(value.args) + opcode
        return call if value.state is None else call + _emit(value.state) + pickle.BUILD
    raise ValueError(f"a cell must be a number, text or None, got {type(value).__name__}")
