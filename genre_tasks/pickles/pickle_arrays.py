"""Arrays out of a pickle's tree: what numpy, pandas and Arrow wrote, checked against the bytes that are there."""

from __future__ import annotations

import math
import re
import uuid
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from genre_tasks.pickles.pickle_machine import Call, Global, PickleBrokenError, PickleRefusedError

_NUMBER_DTYPE = re.compile(r"[fiu][1248]|b1")
_TIME_UNITS: Mapping[bytes, float] = {b"s": 1.0, b"ms": 1e3, b"us": 1e6, b"ns": 1e9}
_NOT_A_TIME = np.iinfo(np.int64).min
_ARROW_NUMBERS: Mapping[str, str] = {
    **{f"{kind}{8 * size}": f"<{kind[0]}{size}" for kind in ("int", "uint") for size in (1, 2, 4, 8)},
    "float": "<f4",
    "double": "<f8",
}
# numpy writes text of a fixed width as UTF-32, padded with zeros.
_TEXT_ENCODINGS: Mapping[str, str] = {"<": "utf-32-le", ">": "utf-32-be"}


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
    genre_tasks.pickles.pickle_machine.PickleBrokenError: expected two axes
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
        Numbers and booleans with their own dtype, without a copy of the pickle's bytes; times as float64 seconds
        since 1970 (in UTC); categories as the values that they stand for; anything else as objects (str, float, int,
        bool, ``None``). Missing numbers and times are NaN.

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
        return _read_values(buffer, dtype, shape, order == "F")
    if node.function in ("ArrowStringArray", "ArrowExtensionArray"):
        return _read_arrow(node.state["_pa_array"])
    if node.function == "MaskedArray":
        return _read_masked(read_array(node.state["_data"]), read_array(node.state["_mask"]))
    if node.function == "Categorical":
        # Up to pandas 1.2 the state is a dictionary.
        return _read_categories(node.state["_dtype"], node.state["_codes"])
    if node.function == "backed":
        return _read_backed(node)
    raise PickleRefusedError(f"a column stored as {node.function}")


def _read_backed(node: Call) -> NDArray[Any]:
    """An array of pandas that is a numpy array and a dtype: text, categories or times."""
    kind = node.args[0]
    arrays = [part for part in node.state if isinstance(part, Call) and part.function in ("reconstruct", "frombuffer")]
    if kind == Global("Categorical"):
        dtypes = [part for part in node.state if isinstance(part, Call) and part.function == "CategoricalDtype"]
        return _read_categories(dtypes[0], arrays[0])
    if kind in (Global("StringArray"), Global("DatetimeArray")):
        return read_array(arrays[0])
    raise PickleRefusedError(f"a column stored as {getattr(kind, 'name', kind)}")


def _read_masked(values: NDArray[Any], missing: NDArray[Any]) -> NDArray[Any]:
    """Numbers that may be missing: as they are where none is, else with NaN."""
    require(missing.dtype == np.bool_ and missing.shape == values.shape, "a mask of the values' shape")
    if not missing.any():
        return values
    # A boolean has no NaN of its own: such a column becomes one of objects, as pandas writes it.
    filled = values.astype(object) if values.dtype == np.bool_ else values.astype(np.float64)
    filled[missing] = math.nan
    return filled


def _read_categories(dtype: Any, codes_node: Any) -> NDArray[Any]:
    """The values that codes stand for; a negative code is a missing value."""
    index = expect_call(expect_call(dtype, "CategoricalDtype").state["categories"], "new_index").args[1]
    values = _read_range(index) if "start" in index else read_array(index["data"])
    codes = read_array(codes_node)
    require(codes.dtype.kind == "i" and values.ndim == 1 and bool((codes < len(values)).all()), "codes of categories")
    missing = codes < 0
    if not missing.any():
        return values[codes]
    padded = np.append(values.astype(object if values.dtype.kind in "Ob" else np.float64), math.nan)
    return padded[np.where(missing, len(values), codes)]


def _read_range(index: Mapping[str, Any]) -> NDArray[Any]:
    """The numbers of a RangeIndex of categories: few, whatever the pickle asks for."""
    bounds = [index[name] for name in ("start", "stop", "step")]
    require(all(type(bound) is int for bound in bounds), "whole numbers")
    numbers = range(*bounds)
    # Codes of up to two bytes are what categories that were read from a file need.
    require(len(numbers) <= 2**16, "at most 65536 categories")
    return np.array(numbers, dtype=np.int64)


def _read_ndarray(node: Call) -> NDArray[Any]:
    _, shape, dtype_node, fortran, data = node.state
    dtype = _read_dtype(dtype_node)
    if not dtype.hasobject:
        return _read_values(data, dtype_node, shape, bool(fortran))
    require(isinstance(data, list) and len(data) == math.prod(_read_shape(shape)), "as many cells as the shape says")
    objects: NDArray[Any] = np.empty(len(data), dtype=np.object_)
    objects[:] = [_read_object(value) for value in data]
    return objects.reshape(_read_shape(shape), order="F" if fortran else "C")


def _read_values(data: Any, dtype_node: Call, shape: Any, fortran: bool) -> NDArray[Any]:
    """Numbers and booleans, or times in seconds, from their bytes."""
    values = _view_bytes(_read_bytes(data), _read_dtype(dtype_node), shape, fortran)
    return _convert_times(values, dtype_node) if dtype_node.args[0] == "M8" else values


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
    if code == "M8":
        # Read as whole numbers, since only those know what is missing.
        return np.dtype(f"{'>' if byte_order == '>' else '<'}i8")
    if not isinstance(code, str) or not _NUMBER_DTYPE.fullmatch(code) or byte_order not in ("<", ">", "|"):
        raise PickleRefusedError(f"a column of type {code!r}")
    return np.dtype(f"{byte_order}{code}")


def _convert_times(counts: NDArray[Any], dtype_node: Call) -> NDArray[Any]:
    """Seconds since 1970 of counts of a unit, which the dtype's metadata names."""
    unit_node, step = dtype_node.state[8][1][:2]
    unit = _read_bytes(unit_node)
    if unit not in _TIME_UNITS or step != 1:
        raise PickleRefusedError(f"times in units of {step} {unit!r}")
    return np.where(counts == _NOT_A_TIME, math.nan, counts / _TIME_UNITS[unit])


def _read_object(value: Any) -> Any:
    """An entry of an object array: text, a number, or what stands for a missing value."""
    if value is None or type(value) in (bool, int, float, str):
        return value
    # NaN, as in the files that pandas wrote before it had a missing value of its own.
    if value == Global("NA"):
        return math.nan
    if isinstance(value, Call) and value.function == "scalar":
        dtype, data = value.args
        if str(expect_call(dtype, "dtype").args[0]).startswith("U"):
            return _read_bytes(data).decode(_TEXT_ENCODINGS[dtype.state[1]]).rstrip("\0")
        return _view_bytes(_read_bytes(data), _read_dtype(dtype), (1,), False)[0].item()
    if isinstance(value, Call) and value.function == "UUID":
        return str(uuid.UUID(int=value.state["int"]))
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


def _read_arrow(node: Any) -> NDArray[Any]:
    """An Arrow array: (type, length, nulls, offset, [validity bits, …], children, …)."""
    (parts,) = expect_call(node, "arrow_array").args
    kind, length, _, start, buffers = parts[:5]
    alias = expect_call(kind, "arrow_type").args[0]
    require(type(length) is int and type(start) is int and length >= 0 and start >= 0, "an Arrow array's length")
    validity_bits, *data = (None if buffer is None else _read_bytes(buffer) for buffer in buffers)
    # An empty array may come without any buffer.
    if length == 0:
        return np.empty(0, dtype=object)
    if alias in ("string", "large_string"):
        return _read_arrow_strings(data, alias == "large_string", validity_bits, start, length)
    if alias == "bool":
        values: NDArray[Any] = _read_bits(data[0] or b"", start, length)
    elif alias in _ARROW_NUMBERS:
        values = np.frombuffer(data[0] or b"", _ARROW_NUMBERS[alias])[start : start + length]
    else:
        raise PickleRefusedError(f"a column of Arrow type {alias!r}")
    # Before anything of the declared length is made.
    require(len(values) == length, "as many values as the Arrow array says")
    return _read_masked(values, ~_read_validity(validity_bits, start, length))


def _read_arrow_strings(
    data: list[bytes | None], is_large: bool, validity_bits: bytes | None, start: int, length: int
) -> NDArray[Any]:
    """Strings from buffers of offsets (int64 where ``is_large``) and of utf-8."""
    offset_bytes, text = data
    offsets = np.frombuffer(offset_bytes or b"", np.int64 if is_large else np.int32)
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
    return np.ones(length, bool) if bits is None else _read_bits(bits, start, length)


def _read_bits(bits: bytes, start: int, length: int) -> NDArray[np.bool_]:
    """[length] bits of an Arrow buffer."""
    flags = np.unpackbits(np.frombuffer(bits, np.uint8), bitorder="little")[start : start + length]
    require(len(flags) == length, "as many bits as the Arrow array says")
    return flags.astype(bool)
