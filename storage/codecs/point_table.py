"""Points ↔ a table with a row a point, for all nodes of a scene."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pyarrow as pa

from genre_tasks.errors import ArtifactCorruptError
from genre_tasks.scene.chunk import Points
from storage.codecs.tables import REMEDY, check_array, column, column_array, read_table, schema, write_table

# One table for all nodes, because a chunk may have a hundred actors with a few points each.
POINTS = schema(
    "points/1",
    [
        column("node", pa.int64(), "0 static (chunk coordinates), 2 + k actor k (box coordinates)"),
        column("x", pa.float32(), "metres"),
        column("y", pa.float32(), "metres"),
        column("z", pa.float32(), "metres"),
        column("red", pa.uint8(), "sRGB"),
        column("green", pa.uint8(), "sRGB"),
        column("blue", pa.uint8(), "sRGB"),
        column("colored", pa.bool_(), "an image saw it unoccluded"),
        column("frame", pa.int16(), "frame of the log of its sweep"),
    ],
)


def write_points(path: Path, nodes: list[tuple[int, Points]]) -> None:
    """Writes the points of nodes as one table.

    Args:
        path: of the new Parquet file.
        nodes: numbers of the nodes, rising, with their points.

    Raises:
        ValueError: an array has another type or shape than ``Points`` says.
    """
    # All nodes are checked before anything is joined, so that the error can name the node.
    for node, p in nodes:
        check_array(p.positions, f"positions of node {node}", np.float32, (None, 3))
        check_array(p.colors, f"colors of node {node}", np.uint8, (len(p), 3))
        check_array(p.colored, f"colored of node {node}", np.bool_, (len(p),))
        check_array(p.frames, f"frames of node {node}", np.int16, (len(p),))
    positions = np.concatenate([p.positions for _, p in nodes])
    colors = np.concatenate([p.colors for _, p in nodes])
    columns = {
        "node": np.concatenate([np.full(len(p), node, np.int64) for node, p in nodes]),
        **{axis: positions[:, i] for i, axis in enumerate("xyz")},
        **{name: colors[:, i] for i, name in enumerate(("red", "green", "blue"))},
        "colored": np.concatenate([p.colored for _, p in nodes]),
        "frame": np.concatenate([p.frames for _, p in nodes]),
    }
    write_table(path, POINTS, columns)


def read_points(path: Path) -> dict[int, Points]:
    """Reads what :func:`write_points` wrote.

    Args:
        path: of the Parquet file.

    Returns:
        The points of each node that has any.

    Raises:
        ArtifactCorruptError: the table is damaged.
    """
    table = read_table(path, POINTS)[0]
    node = column_array(table, "node")
    # Sorted nodes make each one a slice, found by bisection.
    if np.any(np.diff(node) < 0):
        raise ArtifactCorruptError("Column 'node' is not sorted", remedy=REMEDY, file=path)
    positions = np.stack([column_array(table, c) for c in ("x", "y", "z")], 1)
    colors = np.stack([column_array(table, c) for c in ("red", "green", "blue")], 1)
    colored = column_array(table, "colored")
    frame = column_array(table, "frame")
    points = {}
    for n in np.unique(node).tolist():
        rows = slice(*np.searchsorted(node, [n, n + 1]).tolist())
        # Copied, because a slice would keep the points of all nodes in memory.
        points[n] = Points(positions[rows].copy(), colors[rows].copy(), colored[rows].copy(), frame[rows].copy())
    return points
