"""Reads a small Parquet file with one flipped bit in its footer, for every byte of it; one line of counts at the end.

A process of its own, as Arrow may end it: ``python -m tests.fuzz.footer_flips FILE``.
"""

from __future__ import annotations

import sys
from collections import Counter
from pathlib import Path
from random import Random

import pyarrow as pa
import pyarrow.parquet as pq

from genre_tasks.bounded_parquet import FOR_COLUMNS, RowReader, TableTooLargeError, read_bounded_table


def main(path: Path) -> None:
    """Prints how many files were read, and how many were refused."""
    table = pa.table(
        {"a": [1, None, 3], "b": ["x", "y", "y"], "c": [[1.0], [2.0, 3.0], []], "key.d": [b"1", b"2", None]}
    )
    pq.write_table(table, path, row_group_size=2)
    data = path.read_bytes()
    rng = Random(0)
    counts: Counter[str] = Counter()
    for at in range(len(data) - 8 - int.from_bytes(data[-8:-4], "little"), len(data)):
        damaged = bytearray(data)
        damaged[at] ^= 1 << rng.randrange(8)
        path.write_bytes(damaged)
        try:
            read_bounded_table(path, FOR_COLUMNS)
            RowReader(path, FOR_COLUMNS, ["c"]).read(0)
            counts["read"] += 1
        except (OSError, ValueError, pa.ArrowException, TableTooLargeError):
            counts["refused"] += 1
    sys.stdout.write(f"{counts['read']} {counts['refused']}\n")


if __name__ == "__main__":
    main(Path(sys.argv[1]))
