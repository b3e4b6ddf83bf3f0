"""Parquet tables made to do harm: bombs of repeated rows, and odd values, types and columns."""

from __future__ import annotations

import io
from collections.abc import Sequence
from random import Random
from typing import Any


def make_large_table(rng: Random, data: bytes, others: Sequence[bytes]) -> bytes:
    """Makes a Parquet table of the same schema whose rows repeat the first one: few bytes, much memory."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    table = pq.read_table(io.BytesIO(data))
    count = rng.choice((100_000, 1_000_000, 3_000_000, 8_000_000))
    if not table.num_rows:
        return data
    columns = []
    for name in table.column_names:
        value = table.column(name)[0]
        long = pa.scalar("x" * 10_000) if pa.types.is_string(value.type) and rng.random() < 0.5 else value
        columns.append(
            pa.DictionaryArray.from_arrays(pa.array([0] * 1000, pa.int32()), pa.array([long.as_py()], value.type))
        )
    rows = pa.Table.from_arrays([column.cast(column.type.value_type) for column in columns], schema=table.schema)
    sink = io.BytesIO()
    # Dictionaries and zstd make a few bytes of every group of rows.
    with pq.ParquetWriter(sink, table.schema, compression="ZSTD") as writer:
        block = pa.concat_tables([rows] * 100)
        for _ in range(count // len(block)):
            writer.write_table(block, row_group_size=len(block))
    return sink.getvalue()


def change_table(rng: Random, data: bytes, others: Sequence[bytes]) -> bytes:
    """Changes a value, the type, the name or the number of columns of a Parquet table, which stays Parquet."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    table = pq.read_table(io.BytesIO(data))
    index = rng.randrange(table.num_columns)
    field = table.schema.field(index)
    kind = rng.randrange(7)
    if kind == 6:
        values = pa.array([b"\xff\xfe"] * table.num_rows, pa.binary()).view(pa.string())
        table = table.set_column(index, pa.field(field.name, values.type, nullable=field.nullable), values)
    elif kind == 0:
        table = table.set_column(index, field.with_name("other"), table.column(index))
    elif kind == 1:
        table = table.remove_column(index)
    elif kind == 2:
        values = pa.array([rng.choice(("x", "", "../x"))] * table.num_rows)
        table = table.set_column(index, pa.field(field.name, values.type), values)
    elif kind == 3:
        values = pa.nulls(table.num_rows, field.type)
        table = table.set_column(index, pa.field(field.name, field.type, metadata=field.metadata), values)
    elif kind == 4:
        table = rng.choice((table.slice(0, 0), pa.concat_tables([table] * 3), table.slice(0, 1)))
    else:
        table = table.set_column(index, field, _change_column(rng, table.column(index).combine_chunks()))
    sink = io.BytesIO()
    pq.write_table(table, sink)
    return sink.getvalue()


def _change_column(rng: Random, values: Any) -> Any:
    import pyarrow as pa

    items = values.to_pylist()
    if not items:
        return values
    row = rng.randrange(len(items))
    items[row] = _change_item(rng, items[row])
    try:
        return pa.array(items, values.type)
    except (pa.ArrowException, OverflowError, TypeError, ValueError):
        # The type does not hold it.
        return values


def _change_item(rng: Random, item: Any) -> Any:
    if isinstance(item, list):
        return rng.choice((item[:-1], item * 2, [float("nan")] * len(item), [1e300] * len(item)))
    if isinstance(item, float):
        return rng.choice((float("nan"), float("inf"), -1.0, 0.0, 1e300))
    if isinstance(item, int):
        return rng.choice((-1, 0, 2**15 - 1, 2**31 - 1, 2**63 - 1, -(2**63)))
    if isinstance(item, bytes):
        return rng.choice((b"", item[: len(item) // 2], b"x" * 100))
    return rng.choice(("", "../../x", "\0", "x" * 1000, "{", "NaN"))
