"""Arrays out of a pickle's tree: what numpy, pandas and Arrow wrote, checked against the bytes that are there."""

from __future__ import annotations

import math
import re
from typing import Any

import numpy as np
from numpy.typing import NDArray

from genre_tasks.logs.pandaset.pickle_machine import Call, Global, PickleBrokenError, PickleRefusedError

_NUMBER_DTYPE = re.compile(r"[fiu][1248]|b1")


def require(condition: bool, expected: str) -> None:
    """Stops reading a pickle that is not built as expected.

    Args:
        condition: what must be true.
        expected: names it in the message.

    Raises:
        PickleBrokenError: the condition is false.

    >>> require(True, "two axes")
    >>> require(False, "two axes")
    Traceback (most recent call last):
    ...
    genre_tasks.logs.pandaset.pickle_machine.PickleBrokenError: expected two axes
    """
    if not condition:
        raise PickleBrokenError(f"expected {expected}")


def expect_call(node: Any, function: str) -> Call:
    """Checks that a node of the tree is a call of a function.

    Args:
        node: a value or note from ``read_pickle_tree``.
        function: the function's name on the allow-list.

    Returns:
        The node.

    Raises:
        PickleBrokenError: it is anything else.
    """
    if isinstance(node, Call) and node.function == function:
        return node
    found = node.function if isinstance(node, Call) else type(node).__name__
    raise PickleBrokenError(f"expected {function}, found {found}")


def read_array(node: Any) -> NDArray[Any]:
    """Reads an array, in any of the ways in which pandas and numpy write one.

    Args:
        node: the call that would make the array.

    Returns:
        Numbers and booleans with their own dtype, without a copy of the pickle's bytes; anything else as objects
        (str, float, int, bool, ``None``).

    Raises:
        PickleRefusedError: the array is of a kind that no table of numbers and strings needs.
        PickleBrokenError: its shape and its bytes do not fit.
    """
    if not isinstance(node, Call):
        raise PickleBrokenError("expected an array")
    if node.function == "reconstruct":
        return _read_ndarray(node)
    if node.function == "frombuffer":
        buffer, dtype, shape, order = node.args
        return _view_bytes(_read_bytes(buffer), _read_dtype(dtype), shape, order == "F")
    if node.function == "ArrowStringArray":
        return _read_arrow_strings(node.state["_pa_array"])
    if node.function == "backed" and node.args[:1] == (Global("StringArray"),):
        arrays = [part for part in node.state if isinstance(part, Call) and part.function == "reconstruct"]
        return _read_ndarray(arrays[0])
    raise PickleRefusedError(f"a column stored as {node.function}")


def _read_ndarray(node: Call) -> NDArray[Any]:
    _, shape, dtype_node, fortran, data = node.state
    dtype = _read_dtype(dtype_node)
    if not dtype.hasobject:
        return _view_bytes(_read_bytes(data), dtype, shape, bool(fortran))
    require(isinstance(data, list) and len(data) == math.prod(_read_shape(shape)), "as many cells as the shape says")
    objects: NDArray[Any] = np.empty(len(data), dtype=np.object_)
    objects[:] = [_read_object(value) for value in data]
    return objects.reshape(_read_shape(shape), order="F" if fortran else "C")


def _read_shape(node: Any) -> tuple[int, ...]:
    # By type and not by isinstance, since a bool is an int too.
    require(isinstance(node, tuple) and all(type(n) is int and n >= 0 for n in node), "a shape")
    return node


def _view_bytes(data: bytes, dtype: np.dtype[Any], shape: Any, fortran: bool) -> NDArray[Any]:
    """The bytes as an array; a shape that asks for more bytes than there are is refused before anything is made."""
    # Python integers cannot overflow, so no product of sizes is small by accident.
    sizes = _read_shape(shape)
    require(not dtype.hasobject and len(data) == math.prod(sizes) * dtype.itemsize, "as many bytes as the shape says")
    return np.frombuffer(data, dtype).reshape(sizes, order="F" if fortran else "C")


def _read_dtype(node: Any) -> np.dtype[Any]:
    """Numbers and objects only: no structures, no sizes of the pickle's choosing."""
    dtype_call = expect_call(node, "dtype")
    code = dtype_call.args[0]
    byte_order = dtype_call.state[1]
    if code == "O8":
        return np.dtype(object)
    if not isinstance(code, str) or not _NUMBER_DTYPE.fullmatch(code) or byte_order not in ("<", ">", "|"):
        raise PickleRefusedError(f"a column of type {code!r}")
    return np.dtype(f"{byte_order}{code}")


def _read_object(value: Any) -> Any:
    """An entry of an object array: text, a number, or what stands for a missing value."""
    if value is None or type(value) in (bool, int, float, str):
        return value
    # NaN, as in the files that pandas wrote before it had a missing value of its own.
    if value == Global("NA"):
        return math.nan
    if isinstance(value, Call) and value.function == "scalar":
        dtype, data = value.args
        return _view_bytes(_read_bytes(data), _read_dtype(dtype), (1,), False)[0].item()
    raise PickleRefusedError(f"a cell that is neither number nor text ({type(value).__name__})")


def _read_bytes(node: Any) -> bytes:
    if isinstance(node, (bytes, bytearray)):
        return bytes(node)
    if isinstance(node, Call) and node.function in ("bytearray", "py_buffer"):
        return _read_bytes(node.args[0]) if node.args else b""
    # Protocol 2 has no bytes: they come as text of that encoding.
    encoded = expect_call(node, "encode").args
    require(len(encoded) == 2 and isinstance(encoded[0], str) and encoded[1] in ("latin1", "latin-1"), "bytes")
    return encoded[0].encode("latin-1")


def _read_arrow_strings(node: Any) -> NDArray[Any]:
    """An Arrow string array: (type, length, nulls, offset, [validity bits, offsets, utf-8], children, …)."""
    (parts,) = expect_call(node, "arrow_array").args
    kind, length, _, start, buffers = parts[:5]
    alias = expect_call(kind, "arrow_type").args[0]
    if alias not in ("string", "large_string"):
        raise PickleRefusedError(f"a column of Arrow type {alias!r}")
    require(type(length) is int and type(start) is int and length >= 0 and start >= 0, "an Arrow array's length")
    validity_bits, offset_bytes, text = (None if buffer is None else _read_bytes(buffer) for buffer in buffers)
    # An empty array may come without any buffer.
    if length == 0:
        return np.empty(0, dtype=object)
    offsets = np.frombuffer(offset_bytes or b"", np.int64 if alias == "large_string" else np.int32)
    offsets = offsets[start : start + length + 1]
    require(len(offsets) == length + 1 and offsets[0] >= 0 and bool((np.diff(offsets) >= 0).all()), "Arrow offsets")
    require(offsets[-1] <= len(text or b""), "the text of the Arrow array")
    valid = _read_validity(validity_bits, start, length)
    strings = np.empty(length, dtype=object)
    for i in range(length):
        strings[i] = (text or b"")[offsets[i] : offsets[i + 1]].decode() if valid[i] else math.nan
    return strings


def _read_validity(bits: bytes | None, start: int, length: int) -> NDArray[np.bool_]:
    """[length] which entries of an Arrow array are not null; without bits, all of them."""
    if bits is None:
        return np.ones(length, bool)
    flags = np.unpackbits(np.frombuffer(bits, np.uint8), bitorder="little")[start : start + length]
    require(len(flags) == length, "the validity of the Arrow array")
    return flags.astype(bool)
