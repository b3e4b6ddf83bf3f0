"""Reads a pickled pandas DataFrame of numbers and strings, without pandas and without running the pickle.

The allow-list below is what pandas 0.25 to 3 writes for such a frame (block manager, index, numpy arrays, Arrow string
columns) and nothing else; see ``pickle_machine`` for how the pickle is read. Sizes are bounded by the bytes that are
really there: a declared shape allocates nothing.
"""

from __future__ import annotations

import gzip
import zlib
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from numpy.typing import NDArray

from genre_tasks.errors import InputError
from genre_tasks.logs.pandaset.pickle_arrays import call, need, values
from genre_tasks.logs.pandaset.pickle_machine import (
    Call,
    Global,
    PickleBrokenError,
    PickleRefusedError,
    read_pickle_tree,
)

# A PandaSet sweep is 8 MB unpacked; a file that unpacks to more than this is no sweep (a "gzip bomb").
MAX_UNPACKED_BYTES = 512 * 2**20

ALLOWED: Mapping[tuple[str, str], str] = {
    ("pandas.core.frame", "DataFrame"): "DataFrame",
    ("pandas", "DataFrame"): "DataFrame",
    ("pandas.core.internals.managers", "BlockManager"): "BlockManager",
    ("pandas._libs.internals", "_unpickle_block"): "block",
    ("pandas.core.indexes.base", "_new_Index"): "new_index",
    ("pandas.core.indexes.base", "Index"): "Index",
    ("pandas", "Index"): "Index",
    ("pandas.core.indexes.numeric", "Int64Index"): "Index",
    ("pandas.core.indexes.range", "RangeIndex"): "RangeIndex",
    ("pandas", "RangeIndex"): "RangeIndex",
    ("pandas.arrays", "ArrowStringArray"): "ArrowStringArray",
    ("pandas.core.arrays.string_arrow", "ArrowStringArray"): "ArrowStringArray",
    ("pandas.core.arrays.string_arrow", "ArrowStringArrayNumpySemantics"): "ArrowStringArray",
    ("pandas.arrays", "StringArray"): "StringArray",
    ("pandas.core.arrays.string_", "StringArray"): "StringArray",
    ("pandas._libs.arrays", "__pyx_unpickle_NDArrayBacked"): "backed",
    ("pandas", "StringDtype"): "StringDtype",
    ("pandas.core.arrays.string_", "StringDtype"): "StringDtype",
    ("pandas", "NA"): "NA",
    ("pandas._libs.missing", "NA"): "NA",
    ("pyarrow.lib", "_restore_array"): "arrow_array",
    ("pyarrow.lib", "type_for_alias"): "arrow_type",
    ("pyarrow.lib", "py_buffer"): "py_buffer",
    ("numpy", "ndarray"): "ndarray",
    ("numpy", "dtype"): "dtype",
    ("numpy.core.multiarray", "_reconstruct"): "reconstruct",
    ("numpy._core.multiarray", "_reconstruct"): "reconstruct",
    ("numpy.core.multiarray", "scalar"): "scalar",
    ("numpy._core.multiarray", "scalar"): "scalar",
    ("numpy.core.numeric", "_frombuffer"): "frombuffer",
    ("numpy._core.numeric", "_frombuffer"): "frombuffer",
    ("builtins", "slice"): "slice",
    ("builtins", "bytearray"): "bytearray",
    ("__builtin__", "slice"): "slice",
    ("__builtin__", "bytearray"): "bytearray",
    ("__builtin__", "bytes"): "bytearray",
    ("_codecs", "encode"): "encode",
}


@dataclass(frozen=True)
class Frame:
    """The columns of a frame, in order: numbers with their own dtype, strings (and mixed cells) as object arrays.

    Every column is one-dimensional of length ``row_count``. Missing strings are ``None`` or NaN, as they were written.
    """

    columns: Mapping[str, NDArray[Any]]
    row_count: int


def read_frame(path: Path, **where: Any) -> Frame:
    """Reads a ``.pkl`` or ``.pkl.gz`` of one pandas DataFrame.

    Args:
        path: the file; gzip is recognised by its first bytes.
        where: ``log``, ``frame``, … of the error, should there be one.

    Raises:
        InputError: no such file; truncated or corrupt; a pickle that asks for anything else.
    """
    try:
        data = _unpack(path)
    except (OSError, EOFError, zlib.error) as error:
        raise InputError(
            f"the file cannot be unpacked ({error})",
            remedy="Copy or download it again; or remove it: a missing sweep is survived.",
            file=path,
            **where,
        ) from error
    try:
        return parse_frame(data)
    except PickleRefusedError as error:
        raise InputError(
            f"the pickle was refused: it asks for what no table of numbers and strings needs, {error.asked_for}",
            remedy="Do not open it by other means before you know where it comes from: a pickle can run code. Get the "
            "file from its publisher, or write it with pandas.DataFrame.to_pickle from numbers and strings only.",
            file=path,
            **where,
        ) from error
    except PickleBrokenError as error:
        raise InputError(
            f"the file holds no readable pickle of a pandas DataFrame ({error})",
            remedy="Copy or download it again; or remove it: a missing sweep is survived.",
            file=path,
            **where,
        ) from error


def parse_frame(data: bytes) -> Frame:
    """The frame in a pickle's bytes. Raises ``PickleRefusedError`` or ``PickleBrokenError``."""
    tree = read_pickle_tree(data, ALLOWED)
    try:
        return _frame(tree)
    except (ValueError, TypeError, LookupError, OverflowError, AttributeError, RecursionError) as error:
        raise PickleBrokenError(f"{type(error).__name__}: {error}") from error


def _unpack(path: Path) -> bytes:
    with path.open("rb") as raw:
        packed = raw.read(2) == b"\x1f\x8b"
        raw.seek(0)
        data = (gzip.GzipFile(fileobj=raw) if packed else raw).read(MAX_UNPACKED_BYTES + 1)
    if len(data) > MAX_UNPACKED_BYTES:
        raise EOFError(f"more than {MAX_UNPACKED_BYTES >> 20} MiB unpacked")
    return data


def _frame(tree: Any) -> Frame:
    state = call(tree, "DataFrame").state
    need(isinstance(state, dict), "a frame's state")
    blocks, axes = _manager(state.get("_mgr", state.get("_data")))
    need(isinstance(axes, list) and len(axes) == 2, "two axes")
    names = _labels(axes[0])
    row_count = _index_length(axes[1])
    columns: list[NDArray[Any] | None] = [None] * len(names)
    for block, places in blocks:
        array = values(block)
        array = array.reshape(1, -1) if array.ndim == 1 else array
        at = _places(places, len(names))
        need(array.shape == (len(at), row_count), f"a block of {len(at)} columns and {row_count} rows")
        for row, column in enumerate(at):
            need(columns[column] is None, "each column once")
            columns[column] = array[row]
    need(all(column is not None for column in columns), "a block for every column")
    need(len(set(names)) == len(names), "columns of different names")
    return Frame({name: column for name, column in zip(names, columns, strict=True) if column is not None}, row_count)


def _manager(node: Any) -> tuple[list[tuple[Any, Any]], Any]:
    """(values, places) of every block, and the axes: pandas ≥ 1.3 passes them, before that they are the state."""
    manager = call(node, "BlockManager")
    if manager.state is None:
        blocks, axes = manager.args
        return [call(block, "block").args[:2] for block in blocks], axes
    state = manager.state[3]["0.14.1"]
    return [(block["values"], block["mgr_locs"]) for block in state["blocks"]], state["axes"]


def _places(node: Any, count: int) -> list[int]:
    if isinstance(node, Call) and node.function == "slice":
        return list(range(count))[slice(*_integers(node.args))]
    at = values(node)
    need(at.ndim == 1 and at.dtype.kind in "iu" and bool(((at >= 0) & (at < count)).all()), "column numbers")
    return [int(column) for column in at]


def _integers(values: tuple[Any, ...]) -> tuple[Any, ...]:
    need(all(v is None or type(v) is int for v in values), "whole numbers")
    return values


def _index(node: Any) -> tuple[str, dict[str, Any]]:
    kind, state = call(node, "new_index").args
    need(isinstance(kind, Global) and isinstance(state, dict), "an index")
    return kind.name, state


def _labels(node: Any) -> list[str]:
    kind, state = _index(node)
    need(kind == "Index", "named columns")
    names = list(values(state["data"]))
    need(all(type(name) is str for name in names), "columns named by text")
    return names


def _index_length(node: Any) -> int:
    kind, state = _index(node)
    if kind == "RangeIndex":
        start, stop, step = _integers((state["start"], state["stop"], state["step"]))
        return len(range(start, stop, step))
    return len(values(state["data"]))
