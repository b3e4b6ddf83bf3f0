"""Arrays out of a pickle's tree: what numpy, pandas and Arrow wrote, checked against the bytes that are there."""

from __future__ import annotations

import math
import re
from typing import Any

import numpy as np
from numpy.typing import NDArray

from genre_tasks.logs.pandaset.pickle_machine import Call, Global, PickleBrokenError, PickleRefusedError

_NUMBER_DTYPE = re.compile(r"[fiu][1248]|b1")


def need(condition: bool, what: str) -> None:
    if not condition:
        raise PickleBrokenError(f"expected {what}")


def call(node: Any, function: str) -> Call:
    if isinstance(node, Call) and node.function == function:
        return node
    found = node.function if isinstance(node, Call) else type(node).__name__
    raise PickleBrokenError(f"expected {function}, found {found}")


def values(node: Any) -> NDArray[Any]:
    """An array, in any of the ways in which pandas and numpy write one."""
    if not isinstance(node, Call):
        raise PickleBrokenError("expected an array")
    if node.function == "reconstruct":
        return _ndarray(node)
    if node.function == "frombuffer":
        buffer, dtype, shape, order = node.args
        return _shaped(_bytes(buffer), _dtype(dtype), shape, order == "F")
    if node.function == "ArrowStringArray":
        return _arrow_strings(node.state["_pa_array"])
    if node.function == "backed" and node.args[:1] == (Global("StringArray"),):
        cells = [part for part in node.state if isinstance(part, Call) and part.function == "reconstruct"]
        return _ndarray(cells[0])
    raise PickleRefusedError(f"a column stored as {node.function}")


def _ndarray(node: Call) -> NDArray[Any]:
    _, shape, dtype_node, fortran, data = node.state
    dtype = _dtype(dtype_node)
    if not dtype.hasobject:
        return _shaped(_bytes(data), dtype, shape, bool(fortran))
    need(isinstance(data, list) and len(data) == math.prod(_shape(shape)), "as many cells as the shape says")
    cells: NDArray[Any] = np.empty(len(data), dtype=np.object_)
    cells[:] = [_cell(value) for value in data]
    return cells.reshape(_shape(shape), order="F" if fortran else "C")


def _shape(node: Any) -> tuple[int, ...]:
    need(isinstance(node, tuple) and all(type(n) is int and n >= 0 for n in node), "a shape")
    return node


def _shaped(data: bytes, dtype: np.dtype[Any], shape: Any, fortran: bool) -> NDArray[Any]:
    dims = _shape(shape)
    need(not dtype.hasobject and len(data) == math.prod(dims) * dtype.itemsize, "as many bytes as the shape says")
    return np.frombuffer(data, dtype).reshape(dims, order="F" if fortran else "C")


def _dtype(node: Any) -> np.dtype[Any]:
    """Numbers and objects only: no structures, no sizes of the pickle's choosing."""
    made = call(node, "dtype")
    code, order = made.args[0], made.state[1]
    if code == "O8":
        return np.dtype(object)
    if not isinstance(code, str) or not _NUMBER_DTYPE.fullmatch(code) or order not in ("<", ">", "|"):
        raise PickleRefusedError(f"a column of type {code!r}")
    return np.dtype(f"{order}{code}")


def _cell(value: Any) -> Any:
    if value is None or type(value) in (bool, int, float, str):
        return value
    if value == Global("NA"):
        return math.nan
    if isinstance(value, Call) and value.function == "scalar":
        dtype, data = value.args
        return _shaped(_bytes(data), _dtype(dtype), (1,), False)[0].item()
    raise PickleRefusedError(f"a cell that is neither number nor text ({type(value).__name__})")


def _bytes(node: Any) -> bytes:
    if isinstance(node, (bytes, bytearray)):
        return bytes(node)
    if isinstance(node, Call) and node.function in ("bytearray", "py_buffer"):
        return _bytes(node.args[0]) if node.args else b""
    encoded = call(node, "encode").args  # protocol 2 has no bytes: they come as text of that encoding
    need(len(encoded) == 2 and isinstance(encoded[0], str) and encoded[1] in ("latin1", "latin-1"), "bytes")
    return encoded[0].encode("latin-1")


def _arrow_strings(node: Any) -> NDArray[Any]:
    """An Arrow string array: (type, length, nulls, offset, [validity bits, offsets, utf-8], children, …)."""
    (parts,) = call(node, "arrow_array").args
    kind, length, _, start, buffers = parts[:5]
    alias = call(kind, "arrow_type").args[0]
    if alias not in ("string", "large_string"):
        raise PickleRefusedError(f"a column of Arrow type {alias!r}")
    need(type(length) is int and type(start) is int and length >= 0 and start >= 0, "an Arrow array's length")
    validity, offset_bytes, text = (b if b is None else _bytes(b) for b in buffers)
    if length == 0:
        return np.empty(0, dtype=object)
    offsets = np.frombuffer(offset_bytes or b"", np.int64 if alias == "large_string" else np.int32)
    offsets = offsets[start : start + length + 1]
    need(len(offsets) == length + 1 and offsets[0] >= 0 and bool((np.diff(offsets) >= 0).all()), "Arrow offsets")
    need(offsets[-1] <= len(text or b""), "the text of the Arrow array")
    valid = np.ones(length, bool)
    if validity is not None:
        bits = np.unpackbits(np.frombuffer(validity, np.uint8), bitorder="little")[start : start + length]
        need(len(bits) == length, "the validity of the Arrow array")
        valid = bits.astype(bool)
    cells = np.empty(length, dtype=object)
    for i in range(length):
        cells[i] = (text or b"")[offsets[i] : offsets[i + 1]].decode() if valid[i] else math.nan
    return cells
