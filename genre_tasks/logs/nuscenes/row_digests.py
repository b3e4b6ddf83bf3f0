"""Digests of rows in an index: SQLite notices a damaged page by its structure, but never a value that has changed."""

from __future__ import annotations

import hashlib
import sqlite3
from collections.abc import Iterable, Sequence
from typing import Any


def create_digest_table(index: sqlite3.Connection) -> None:
    """Makes the table of digests.

    Args:
        index: that is being made.
    """
    index.execute("CREATE TABLE row_digest (name TEXT, scene TEXT, digest TEXT, PRIMARY KEY (name, scene))")


def write_row_digest(index: sqlite3.Connection, table: str, scene: str, rows: Iterable[Sequence[Any]]) -> None:
    """Writes the digest of rows that are later read together.

    Args:
        index: that is being made.
        table: name of the table that they are mainly of.
        scene: token of their scene; empty for the rows of all scenes.
        rows: in the order in which they are read.
    """
    index.execute("INSERT INTO row_digest VALUES (?, ?, ?)", (table, scene, _digest_rows(rows)))


def check_rows(index: sqlite3.Connection, table: str, scene: str, rows: Iterable[Sequence[Any]]) -> None:
    """Compares rows with their digest.

    Args:
        index: that they were read from.
        table: name of the table that they are mainly of.
        scene: token of their scene; empty for the rows of all scenes.
        rows: as they were read.

    Raises:
        sqlite3.DatabaseError: they are not the rows that were written.
    """
    query = "SELECT digest FROM row_digest WHERE name = ? AND scene = ?"
    written = index.execute(query, (table, scene)).fetchone()
    if written is None or written[0] != _digest_rows(rows):
        raise sqlite3.DatabaseError(f"rows of the table {table} are not those that were written")


def _digest_rows(rows: Iterable[Sequence[Any]]) -> str:
    total = hashlib.sha256()
    for row in rows:
        # In ASCII: which other characters Python escapes depends on its version.
        total.update(ascii(tuple(row)).encode())
    return total.hexdigest()
