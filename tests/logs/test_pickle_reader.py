"""The pickle reader agrees with pandas on frames, and refuses everything that is not one."""

from __future__ import annotations

import builtins
import copyreg
import functools
import gzip
import io
import os
import pickle
import struct
import subprocess
import tracemalloc
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from genre_tasks.errors import InputError
from genre_tasks.logs.pandaset.pickle_reader import Table, parse_table, read_table
from genre_tasks.logs.pandaset.pickle_writer import pickle_table
from genre_tasks.pickles.pickle_machine import PickleBrokenError, PickleRefusedError

REAL = Path(__file__).resolve().parents[3] / "shared/data/pandaset/002"


def assert_same(frame: Table, table: Any) -> None:
    """Columns, order, dtypes and cells as pandas reads them (text columns as objects)."""
    import pandas as pd

    assert list(frame.columns) == list(table.columns)
    assert frame.row_count == len(table)
    for name, values in frame.columns.items():
        expected = table[name].to_numpy()
        assert values.dtype == expected.dtype
        if values.dtype == object:
            for found, cell in zip(values, expected, strict=True):
                plain = cell.item() if isinstance(cell, np.generic) else cell
                assert (pd.isna(found) and pd.isna(cell)) or (found == cell and type(found) is type(plain))
        else:
            np.testing.assert_array_equal(values, expected)


def make_table() -> Any:
    pd = pytest.importorskip("pandas")
    return pd.DataFrame(
        {
            "uuid": ["a", "bé", "c", ""],
            "x": [1.0, np.nan, -np.inf, 1e-310],
            "count": [1, 2, 3, -(2**62)],
            "still": [True, False, True, True],
            "motion": ["Moving", None, "Parked", None],
            "single": np.array([1, 2, 3, 4], dtype=np.float32),
            "byte": np.array([1, 2, 3, 255], dtype=np.uint8),
            "y": [0.5, 1.5, 2.5, 3.5],
        }
    )


TABLES: dict[str, Callable[[Any], Any]] = {
    "whole": lambda t: t,
    "filtered": lambda t: t[t.x < 2],
    "one column": lambda t: t[["uuid"]],
    "empty": lambda t: t.iloc[:0],
    "objects": lambda t: t.astype({"uuid": object, "motion": object}),
    "numpy cells": lambda t: t.assign(mixed=np.array([np.float64(1), "x", None, np.int64(3)], dtype=object)),
    "stacked": lambda t: __import__("pandas").concat([t, t]),
    "reordered": lambda t: t[["y", "uuid", "x", "motion"]],
    "sliced": lambda t: t.iloc[1:3],
}


EXTENSION_DTYPES: dict[str, list[Any]] = {
    "category": ["Car", "Bus", None, "Car"],
    "Int64": [1, 2, None],
    "UInt8": [1, 2, 3],
    "Float32": [1.5, None],
    "Float64": [1.5, 2.0],
    "boolean": [True, None, False],
    "string": ["a", None, "b"],
    "datetime64[ns]": ["2019-05-06T21:46:00.5", None],
    "datetime64[ms]": ["2019-05-06T21:46:00.5", "2020-01-01"],
    "datetime64[ns, UTC]": ["2019-05-06T21:46:00.5", "2020-01-01"],
    "int16[pyarrow]": [1, None],
    "double[pyarrow]": [1.5, None],
    "bool[pyarrow]": [True, None, False],
    "string[pyarrow]": ["a", None, "b"],
}


class TestAgreesWithPandas:
    @pytest.mark.parametrize("protocol", [2, 3, 4, 5])
    @pytest.mark.parametrize("kind", TABLES)
    def test_written_by_pandas(self, tmp_path: Path, protocol: int, kind: str) -> None:
        pd = pytest.importorskip("pandas")
        path = tmp_path / "00.pkl.gz"
        TABLES[kind](make_table()).to_pickle(path, compression="gzip", protocol=protocol)
        assert_same(read_table(path), pd.read_pickle(path))

    @pytest.mark.parametrize("protocol", [2, 3, 4, 5])
    @pytest.mark.parametrize("dtype", EXTENSION_DTYPES)
    def test_dtypes_of_pandas(self, protocol: int, dtype: str) -> None:
        """Report: pandas-dev/pandas#61763 (dtypes that come and go with the version of pandas)."""
        pd = pytest.importorskip("pandas")
        if "pyarrow" in dtype:
            pytest.importorskip("pyarrow")
        values = EXTENSION_DTYPES[dtype]
        table = pd.DataFrame({"x": range(len(values)), "a": pd.Series(values).astype(dtype)})
        found = parse_table(pickle.dumps(table, protocol=protocol)).columns["a"].tolist()
        expected = [value.timestamp() if isinstance(value, pd.Timestamp) else value for value in table["a"]]
        assert [None if pd.isna(value) else value for value in found] == [
            None if pd.isna(value) else value for value in expected
        ]

    def test_rows_with_several_keys(self) -> None:
        pd = pytest.importorskip("pandas")
        table = pd.concat({"a": make_table(), "b": make_table()})
        assert parse_table(pickle.dumps(table)).row_count == 8

    def test_a_range_of_categories_is_bounded(self) -> None:
        pd = pytest.importorskip("pandas")
        dtype = pd.CategoricalDtype(pd.RangeIndex(0, 100_000))
        with pytest.raises(PickleBrokenError, match="65536 categories"):
            parse_table(pickle.dumps(pd.DataFrame({"a": pd.Series([1, 2], dtype=dtype)})))

    def test_python_string_storage(self) -> None:
        pd = pytest.importorskip("pandas")
        dtype = pd.StringDtype("python", na_value=np.nan)
        table = pd.DataFrame({"a": pd.array(["x", None, "z"], dtype=dtype)})
        frame = parse_table(pickle.dumps(table))
        assert list(frame.columns["a"][[0, 2]]) == ["x", "z"]
        assert np.isnan(frame.columns["a"][1])

    def test_not_compressed(self, tmp_path: Path) -> None:
        pd = pytest.importorskip("pandas")
        make_table().to_pickle(tmp_path / "00.pkl")
        assert_same(read_table(tmp_path / "00.pkl"), pd.read_pickle(tmp_path / "00.pkl"))

    def test_pandas_reads_what_we_write(self) -> None:
        pytest.importorskip("pandas")
        columns = {
            "x": np.array([1.0, np.nan, 3.0]),
            "label": np.array(["a", None, "é"], dtype=object),
            "d": np.array([0, 1, -(2**40)]),
            "still": np.array([True, False, True]),
            "y": np.array([4.0, 5.0, 6.0]),
        }
        table = pickle.loads(pickle_table(columns))
        assert list(table.columns) == list(columns)
        assert list(table.index) == [0, 1, 2]
        assert_same(parse_table(pickle_table(columns)), table.astype({"label": object}))
        assert pickle_table(columns) == pickle_table(columns)

    @pytest.mark.real
    @pytest.mark.skipif(not REAL.is_dir(), reason=f"no PandaSet sequence beside the checkout ({REAL})")
    @pytest.mark.parametrize("pattern", ["lidar/0[0-3].pkl.gz", "annotations/*/*.pkl.gz"])
    def test_real_files(self, pattern: str) -> None:
        pd = pytest.importorskip("pandas")
        paths = sorted(REAL.glob(pattern))
        assert len(paths) >= 4
        for path in paths:
            assert_same(read_table(path), pd.read_pickle(path))


class Reduces:
    """An object whose pickle asks for ``function(*args)``."""

    def __init__(self, function: Any, *args: Any) -> None:
        self.asks = (function, args)

    def __reduce__(self) -> Any:
        return self.asks


class NestedFunction:
    """Pickles as ``getattr(os, "system")`` called with a command: the function itself comes from a call."""

    def __reduce__(self) -> Any:
        return (functools.partial(os.system), ("touch PWNED",))


def frame_with_cell(cell: Any) -> bytes:
    pd = pytest.importorskip("pandas")
    return pickle.dumps(pd.DataFrame({"a": pd.Series([cell, "x"], dtype=object)}))


TOUCH = "touch PWNED"
HOSTILE: dict[str, Callable[[], bytes]] = {
    "os.system": lambda: pickle.dumps(Reduces(os.system, TOUCH)),
    "posix.system, written by hand": lambda: b"cposix\nsystem\n(X\x0b\x00\x00\x00touch PWNEDtR.",
    "builtins.eval": lambda: pickle.dumps(Reduces(builtins.eval, "open('PWNED', 'w')")),
    "builtins.exec": lambda: pickle.dumps(Reduces(builtins.exec, "open('PWNED', 'w')")),
    "builtins.getattr": lambda: pickle.dumps(Reduces(builtins.getattr, "text", "upper")),
    "subprocess.Popen": lambda: pickle.dumps(Reduces(subprocess.Popen, ["touch", "PWNED"])),
    "functools.partial": lambda: pickle.dumps(NestedFunction()),
    "numpy.load": lambda: pickle.dumps(Reduces(np.load, "PWNED.npy", None, True)),
    "dotted name": lambda: b"\x80\x04\x8c\x06pandas\x8c\x12compat.os.system.x\x93.",
    "dotted name of an allowed module": lambda: b"\x80\x04\x8c\x05numpy\x8c\x11dtype.__class__.x\x93.",
    "name made of bytes": lambda: b"\x80\x04C\x02osC\x06system\x93.",
    "nested in a list": lambda: pickle.dumps([1, {"a": (Reduces(os.system, TOUCH),)}]),
    "cell of a frame": lambda: frame_with_cell(Reduces(os.system, TOUCH)),
    "cell of a numpy object array": lambda: pickle.dumps(np.array([Reduces(os.system, TOUCH)], dtype=object)),
    "copyreg reconstructor": lambda: pickle.dumps(Plain(), protocol=2),
    "instance of a class": lambda: pickle.dumps(Plain(), protocol=4),
    "extension registry": lambda: b"\x80\x02\x82\x01.",
    "persistent id": lambda: b"\x80\x02X\x04\x00\x00\x00nameQ.",
    "persistent id, as text": lambda: b"Pname\n.",
    "protocol 0": lambda: pickle.dumps(Reduces(os.system, TOUCH), protocol=0),
    "INST": lambda: b"(X\x0b\x00\x00\x00touch PWNEDios\nsystem\n.",
    "OBJ": lambda: b"(cos\nsystem\nX\x0b\x00\x00\x00touch PWNEDo.",
    "NEWOBJ_EX": lambda: b"\x80\x04cnumpy\nndarray\n)}\x92.",
    "out-of-band buffer": lambda: b"\x80\x05\x97.",
    "state for a class of the list": lambda: b"\x80\x03cpandas\nDataFrame\nN}X\x01\x00\x00\x00aNs\x86b.",
    "call of a call": lambda: b"\x80\x03cbuiltins\nslice\nK\x01\x85R)R.",
    "item of an object that is no dictionary": lambda: b"\x80\x03cnumpy\nndarray\nX\x01\x00\x00\x00aNs.",
    "dictionary with keys of another kind": lambda: b"\x80\x03}K\x01Ns.",
    "class as a cell": lambda: frame_with_cell(int),
    "set": lambda: frame_with_cell({1, 2}),
    "durations": lambda: pickle.dumps(pytest.importorskip("pandas").DataFrame({"t": np.array([1], "m8[ns]")})),
    "sparse": lambda: pickle.dumps(pytest.importorskip("pandas").DataFrame({"t": [0.0]}).astype("Sparse[float]")),
    "void cells": lambda: pickle_table({"x": np.zeros(3)}).replace(b"f8", b"V8"),
    "a dtype with a size of its own": lambda: pickle_table({"x": np.zeros(3)}).replace(
        b"\x02\0\0\0f8", b"\x03\0\0\0U99"
    ),
}


class Plain:
    """Nothing but its class, which the pickle names."""


class TestRefuses:
    @pytest.mark.parametrize("kind", HOSTILE)
    def test_hostile(self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, kind: str) -> None:
        monkeypatch.chdir(tmp_path)
        path = tmp_path / "07.pkl.gz"
        path.write_bytes(gzip.compress(HOSTILE[kind]()))
        with pytest.raises(InputError) as caught:
            read_table(path, frame=7, log="pandaset:here")
        assert caught.value.file == str(path)
        assert caught.value.frame == 7
        assert caught.value.remedy
        assert isinstance(caught.value.__cause__, PickleRefusedError), "refused, not merely broken"
        assert list(tmp_path.iterdir()) == [path], "the pickle ran"

    @pytest.mark.parametrize(
        ("kind", "named"),
        [
            ("os.system", "posix.system"),
            ("builtins.eval", "builtins.eval"),
            ("functools.partial", "functools.partial"),
            ("subprocess.Popen", "subprocess.Popen"),
            ("dotted name", r"pandas\.compat\.os\.system\.x"),
            ("cell of a frame", "posix.system"),
            ("copyreg reconstructor", "Plain"),
            ("extension registry", "EXT1"),
            ("persistent id", "BINPERSID"),
        ],
    )
    def test_names_what_it_asked_for(self, kind: str, named: str) -> None:
        with pytest.raises(PickleRefusedError, match=named):
            parse_table(HOSTILE[kind]())

    def test_a_registered_extension_is_not_looked_up(self) -> None:
        copyreg.add_extension("os", "system", 0x70)
        try:
            with pytest.raises(PickleRefusedError, match="EXT1"):
                parse_table(b"\x80\x02\x82\x70.")
        finally:
            copyreg.remove_extension("os", "system", 0x70)

    def test_other_values_are_no_frame(self) -> None:
        for value in (None, 3, [1], {"DataFrame": 1}, np.zeros(3)):
            with pytest.raises(PickleBrokenError):
                parse_table(pickle.dumps(value))


class TestBounds:
    def _peak(self, data: bytes) -> int:
        tracemalloc.start()
        try:
            with pytest.raises((PickleBrokenError, PickleRefusedError)):
                parse_table(data)
            return tracemalloc.get_traced_memory()[1]
        finally:
            tracemalloc.stop()

    @pytest.mark.parametrize("rows", [10**9, 2**40])
    def test_declared_shapes_do_not_allocate(self, rows: int) -> None:
        data = pickle_table({"x": np.zeros(3), "name": np.array(["a"] * 3, dtype=object)})
        shaped = data.replace(b"J\x03\x00\x00\x00", b"\x8a\x06" + rows.to_bytes(6, "little"))
        assert shaped != data
        assert self._peak(shaped) < 2**20

    @pytest.mark.parametrize("opcode", [b"B" + struct.pack("<I", 2**31 - 1), b"\x8e" + struct.pack("<Q", 2**60)])
    def test_declared_lengths_do_not_allocate(self, opcode: bytes) -> None:
        assert self._peak(b"\x80\x04" + opcode + b"abc.") < 2**20

    def test_deep_nesting_is_no_crash(self) -> None:
        deep = b"\x80\x03)" + b"\x85" * 100_000 + b"."
        with pytest.raises(PickleBrokenError):
            parse_table(deep)
        with pytest.raises(PickleRefusedError):
            parse_table(b"\x80\x03})" + b"\x85" * 100_000 + b"Ns.")

    def test_deep_calls_are_no_crash(self) -> None:
        data = pickle_table({"x": np.zeros(3)})
        numbers = b"B" + struct.pack("<I", 24) + bytes(24)
        wrapped = b"cbuiltins\nbytearray\n" * 5000 + numbers + b"\x85R" * 5000
        assert data.count(numbers) == 1
        with pytest.raises(PickleBrokenError, match="RecursionError"):
            parse_table(data.replace(numbers, wrapped))

    def test_bomb(self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setattr("genre_tasks.logs.pandaset.pickle_reader.MAX_UNPACKED_BYTES", 2**20)
        path = tmp_path / "00.pkl.gz"
        path.write_bytes(gzip.compress(bytes(2**22)))
        with pytest.raises(InputError, match="more than 1 MiB unpacked"):
            read_table(path)


class TestBroken:
    def _packed(self) -> bytes:
        return gzip.compress(pickle_table({"x": np.linspace(0, 1, 500)}))

    @pytest.mark.parametrize(
        "damage",
        [
            lambda data: data[: len(data) // 2],
            lambda data: data[:-4] + b"0000",
            lambda data: b"",
            lambda data: b"\x1f\x8b",
            lambda data: data[:200] + bytes(50) + data[250:],
            lambda data: b"not a pickle at all",
            lambda data: gzip.compress(gzip.decompress(data)[:-100]),
        ],
    )
    def test_damaged_file(self, tmp_path: Path, damage: Callable[[bytes], bytes]) -> None:
        path = tmp_path / "03.pkl.gz"
        path.write_bytes(damage(self._packed()))
        with pytest.raises(InputError) as caught:
            read_table(path, frame=3)
        assert (caught.value.file, caught.value.frame) == (str(path), 3)

    @settings(max_examples=300, deadline=None)
    @given(st.data())
    def test_any_damage_is_one_of_two_errors(self, data: st.DataObject) -> None:
        """Flipped bytes either still give a frame or raise one of the two errors, never anything else."""
        good = bytearray(pickle_table({"x": np.arange(4.0), "label": np.array(list("abcd"), dtype=object)}))
        for _ in range(data.draw(st.integers(1, 4))):
            good[data.draw(st.integers(0, len(good) - 1))] = data.draw(st.integers(0, 255))
        error: Exception | None = None
        try:
            parse_table(bytes(good))
        except Exception as caught:
            error = caught
        assert error is None or isinstance(error, (PickleRefusedError, PickleBrokenError))

    @pytest.mark.parametrize("columns", [{}, {"a": np.zeros(2), "b": np.zeros(3)}, {"a": np.zeros((2, 2))}])
    def test_writer_rejects(self, columns: dict[str, Any]) -> None:
        with pytest.raises(ValueError, match="one length"):
            pickle_table(columns)

    def test_writer_rejects_dtypes_and_cells(self) -> None:
        with pytest.raises(ValueError, match="complex128"):
            pickle_table({"a": np.zeros(2, dtype=complex)})
        with pytest.raises(ValueError, match="BytesIO"):
            pickle_table({"a": np.array([io.BytesIO()], dtype=object)})
