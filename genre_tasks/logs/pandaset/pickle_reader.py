"""Reads a pickled pandas DataFrame of numbers and strings, without pandas and without running the pickle.

The allow-list ``ALLOWED`` is what pandas 0.25 to 3 writes for such a table (block manager, index, numpy arrays, Arrow
string columns) and nothing else; see ``pickle_machine`` for how the pickle is read. Sizes are bounded by the bytes that
are really there: a declared shape allocates nothing.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from numpy.typing import NDArray

from genre_tasks.errors import InputError
from genre_tasks.logs.file_kinds import describe_non_pickle
from genre_tasks.logs.file_reading import describe_os_error
from genre_tasks.logs.pandaset.unpacking import UNPACKING_ERRORS, unpack
from genre_tasks.pickles.pickle_arrays import expect_call, read_array, require
from genre_tasks.pickles.pickle_machine import (
    Call,
    Global,
    PickleBrokenError,
    PickleRefusedError,
    read_pickle_tree,
)

# A PandaSet sweep is 8 MB unpacked; a file that unpacks to more than this is no sweep (a "gzip bomb").
MAX_UNPACKED_BYTES = 512 * 2**20

_COPY_AGAIN = "Copy or download it again; or remove it: a missing sweep is survived."
_EXPECTED = "A pickled pandas DataFrame was expected; without the file, its frame has no sweep or no cuboids."
_MAKE_READABLE = "Make it readable; or remove it: a missing sweep is survived."
_DO_NOT_OPEN = (
    "Do not open it by other means before you know where it comes from: a pickle can run code. Get the file from its "
    "publisher, or write it with pandas.DataFrame.to_pickle from numbers and strings only."
)


def _in_every_pandas(module: str, names: Iterable[str], name: str) -> dict[tuple[str, str], str]:
    """Entries of the allow-list for classes in their module, and where pandas 3 has them."""
    return {(place, cls): name for cls in names for place in (module, "pandas", "pandas.arrays")}


ALLOWED: Mapping[tuple[str, str], str] = {
    # Frames and blocks. Names without a module path are those of pandas 3.
    ("pandas.core.frame", "DataFrame"): "DataFrame",
    ("pandas", "DataFrame"): "DataFrame",
    ("pandas.core.internals.managers", "BlockManager"): "BlockManager",
    ("pandas._libs.internals", "_unpickle_block"): "block",
    # Labels of rows and columns; whole numbers have had a class of their own up to pandas 1.5.
    ("pandas.core.indexes.base", "_new_Index"): "new_index",
    ("pandas.core.indexes.base", "Index"): "Index",
    ("pandas", "Index"): "Index",
    ("pandas.core.indexes.numeric", "Int64Index"): "Index",
    ("pandas.core.indexes.numeric", "Float64Index"): "Index",
    **_in_every_pandas("pandas.core.indexes.range", ["RangeIndex"], "RangeIndex"),
    **_in_every_pandas("pandas.core.indexes.multi", ["MultiIndex"], "MultiIndex"),
    # Text, as Arrow buffers or as Python objects.
    ("pandas.arrays", "ArrowStringArray"): "ArrowStringArray",
    ("pandas.core.arrays.string_arrow", "ArrowStringArray"): "ArrowStringArray",
    ("pandas.core.arrays.string_arrow", "ArrowStringArrayNumpySemantics"): "ArrowStringArray",
    ("pandas.arrays", "StringArray"): "StringArray",
    ("pandas.core.arrays.string_", "StringArray"): "StringArray",
    ("pandas._libs.arrays", "__pyx_unpickle_NDArrayBacked"): "backed",
    # Columns with a dtype of pandas: categories, numbers that may be missing, times, Arrow arrays.
    **_in_every_pandas("pandas.core.arrays.categorical", ["Categorical"], "Categorical"),
    **_in_every_pandas("pandas.core.dtypes.dtypes", ["CategoricalDtype"], "CategoricalDtype"),
    **_in_every_pandas("pandas.core.arrays.integer", ["IntegerArray"], "MaskedArray"),
    **_in_every_pandas("pandas.core.arrays.floating", ["FloatingArray"], "MaskedArray"),
    **_in_every_pandas("pandas.core.arrays.boolean", ["BooleanArray"], "MaskedArray"),
    **_in_every_pandas("pandas.core.arrays.boolean", ["BooleanDtype"], "MaskedDtype"),
    **_in_every_pandas("pandas.core.arrays.floating", ["Float32Dtype", "Float64Dtype"], "MaskedDtype"),
    **_in_every_pandas(
        "pandas.core.arrays.integer",
        [f"{kind}{bits}Dtype" for kind in ("Int", "UInt") for bits in (8, 16, 32, 64)],
        "MaskedDtype",
    ),
    **_in_every_pandas("pandas.core.arrays.datetimes", ["DatetimeArray"], "DatetimeArray"),
    # Times are stored in UTC, so that the zone is of no account.
    **_in_every_pandas("pandas.core.dtypes.dtypes", ["DatetimeTZDtype"], "DatetimeTZDtype"),
    ("datetime", "timezone"): "timezone",
    ("datetime", "timedelta"): "timedelta",
    ("pytz", "_UTC"): "timezone",
    **_in_every_pandas("pandas.core.arrays.arrow.array", ["ArrowExtensionArray"], "ArrowExtensionArray"),
    **_in_every_pandas("pandas.core.dtypes.dtypes", ["ArrowDtype"], "ArrowDtype"),
    ("uuid", "UUID"): "UUID",
    ("pandas", "StringDtype"): "StringDtype",
    ("pandas.core.arrays.string_", "StringDtype"): "StringDtype",
    ("pandas", "NA"): "NA",
    ("pandas._libs.missing", "NA"): "NA",
    ("pyarrow.lib", "_restore_array"): "arrow_array",
    ("pyarrow.lib", "type_for_alias"): "arrow_type",
    ("pyarrow.lib", "py_buffer"): "py_buffer",
    # Arrays; numpy 2 moved the functions that make them to ``numpy._core``.
    ("numpy", "ndarray"): "ndarray",
    ("numpy", "dtype"): "dtype",
    ("numpy.core.multiarray", "_reconstruct"): "reconstruct",
    ("numpy._core.multiarray", "_reconstruct"): "reconstruct",
    ("numpy.core.multiarray", "scalar"): "scalar",
    ("numpy._core.multiarray", "scalar"): "scalar",
    ("numpy.core.numeric", "_frombuffer"): "frombuffer",
    ("numpy._core.numeric", "_frombuffer"): "frombuffer",
    # Python. Protocol 2 calls the module ``__builtin__``, and writes bytes as encoded text.
    ("builtins", "slice"): "slice",
    ("builtins", "bytearray"): "bytearray",
    ("__builtin__", "slice"): "slice",
    ("__builtin__", "bytearray"): "bytearray",
    ("__builtin__", "bytes"): "bytearray",
    ("_codecs", "encode"): "encode",
}


@dataclass(frozen=True)
class Table:
    """A table of numbers and strings.

    Attributes:
        columns: name → [``row_count``], in order: numbers with their own dtype, strings (and mixed columns) as object
            arrays. Missing strings are ``None`` or NaN, as they were written.
        row_count: how many rows every column has.
    """

    columns: Mapping[str, NDArray[Any]]
    row_count: int


def read_table(path: Path, **where: Any) -> Table:
    """Reads a ``.pkl`` of one pandas DataFrame, compressed or not.

    Args:
        path: the file; gzip, bzip2, xz and ZIP are recognised by their first bytes.
        where: ``log``, ``frame``, … of the error, should there be one.

    Returns:
        The table.

    Raises:
        InputError: no such file; truncated or corrupt; a pickle that asks for anything else.
    """
    try:
        data = unpack(path, MAX_UNPACKED_BYTES)
    except UNPACKING_ERRORS as error:
        # An error of the system has a number, one of an unpacker has none.
        if isinstance(error, OSError) and error.errno is not None:
            raise InputError(describe_os_error(error), remedy=_MAKE_READABLE, file=path, **where) from error
        problem = f"the file cannot be unpacked ({error})"
        raise InputError(problem, remedy=_COPY_AGAIN, file=path, **where) from error
    # A pointer, a page or an array is no broken pickle, and copying it again would not help.
    kind = describe_non_pickle(data)
    if kind is not None:
        raise InputError(f"the file is {kind}", remedy=_EXPECTED, file=path, **where)
    try:
        return parse_table(data)
    except PickleRefusedError as error:
        problem = f"the pickle was refused: it asks for what no table of numbers and strings needs, {error.asked_for}"
        raise InputError(problem, remedy=_DO_NOT_OPEN, file=path, **where) from error
    except PickleBrokenError as error:
        problem = f"the file holds no readable pickle of a pandas DataFrame ({error})"
        raise InputError(problem, remedy=_COPY_AGAIN, file=path, **where) from error


def parse_table(data: bytes) -> Table:
    """Reads the table in a pickle's bytes.

    Args:
        data: the pickle of a pandas DataFrame, unpacked.

    Returns:
        The table; its arrays are views of ``data`` where they can be.

    Raises:
        PickleRefusedError: the pickle asks for something that no table of numbers and strings needs.
        PickleBrokenError: it is malformed, or no DataFrame.

    >>> import numpy as np
    >>> from genre_tasks.logs.pandaset.pickle_writer import pickle_table
    >>> parse_table(pickle_table({"x": np.array([1.0, 2.0])}))
    Table(columns={'x': array([1., 2.])}, row_count=2)
    """
    tree = read_pickle_tree(data, ALLOWED)
    try:
        return _read_dataframe(tree)
    except (ValueError, TypeError, LookupError, OverflowError, AttributeError, RecursionError) as error:
        # A tree of the wrong shape shows as any of these; the caller only needs to know that it is no table.
        raise PickleBrokenError(f"{type(error).__name__}: {error}") from error


def _read_dataframe(tree: Any) -> Table:
    state = expect_call(tree, "DataFrame").state
    require(isinstance(state, dict), "a frame's state")
    blocks, axes = _read_block_manager(state.get("_mgr", state.get("_data")))
    require(isinstance(axes, list) and len(axes) == 2, "two axes")
    names = _read_column_names(axes[0])
    row_count = _read_row_count(axes[1])
    columns: list[NDArray[Any] | None] = [None] * len(names)
    for block, places in blocks:
        array = read_array(block)
        # A block of a single column may come as a vector.
        array = array.reshape(1, -1) if array.ndim == 1 else array
        indices = _read_column_indices(places, len(names))
        require(array.shape == (len(indices), row_count), f"a block of {len(indices)} columns and {row_count} rows")
        for row, index in enumerate(indices):
            # Blocks that overlap, or leave a column out, would give a table of other values than pandas.
            require(columns[index] is None, "each column once")
            columns[index] = array[row]
    require(all(column is not None for column in columns), "a block for every column")
    require(len(set(names)) == len(names), "columns of different names")
    return Table({name: column for name, column in zip(names, columns, strict=True) if column is not None}, row_count)


def _read_block_manager(node: Any) -> tuple[list[tuple[Any, Any]], Any]:
    """(values, column indices) of every block, and the axes.

    pandas 1.3 and later pass them as arguments; before that, they are the state.
    """
    manager = expect_call(node, "BlockManager")
    if manager.state is None:
        blocks, axes = manager.args
        return [expect_call(block, "block").args[:2] for block in blocks], axes
    state = manager.state[3]["0.14.1"]
    return [(block["values"], block["mgr_locs"]) for block in state["blocks"]], state["axes"]


def _read_column_indices(node: Any, count: int) -> list[int]:
    """Which of ``count`` columns a block holds: a slice or an array of numbers."""
    if isinstance(node, Call) and node.function == "slice":
        return list(range(count))[slice(*_require_integers(node.args))]
    indices = read_array(node)
    in_range = indices.ndim == 1 and indices.dtype.kind in "iu" and bool(((indices >= 0) & (indices < count)).all())
    require(in_range, "column numbers")
    return [int(index) for index in indices]


def _require_integers(values: tuple[Any, ...]) -> tuple[Any, ...]:
    require(all(value is None or type(value) is int for value in values), "whole numbers")
    return values


def _read_index(node: Any) -> tuple[str, dict[str, Any]]:
    """Class and state of a pandas index."""
    kind, state = expect_call(node, "new_index").args
    require(isinstance(kind, Global) and isinstance(state, dict), "an index")
    return kind.name, state


def _read_column_names(node: Any) -> list[str]:
    kind, state = _read_index(node)
    require(kind == "Index", "named columns")
    names = list(read_array(state["data"]))
    require(all(type(name) is str for name in names), "columns named by text")
    return names


def _read_row_count(node: Any) -> int:
    kind, state = _read_index(node)
    if kind == "RangeIndex":
        start, stop, step = _require_integers((state["start"], state["stop"], state["step"]))
        return len(range(start, stop, step))
    if kind == "MultiIndex":
        return len(read_array(state["codes"][0]))
    return len(read_array(state["data"]))
