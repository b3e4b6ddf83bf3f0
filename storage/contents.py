"""What an artifact holds, in a few counts that a reader wants first; of tables only short columns are read."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from genre_tasks.errors import ArtifactCorruptError
from storage.codecs.tables import REMEDY

if TYPE_CHECKING:
    import pyarrow as pa
    from numpy.typing import NDArray

    from storage.store import Artifact

_SHORT_TABLES = {"evaluation": "metrics.parquet", "effects": "effects.parquet", "rollout_scores": "metrics.parquet"}
_STATIC = 0
_DISTANT = 1


def summarise_contents(artifact: Artifact) -> dict[str, Any]:
    """Counts what an artifact holds, without torch and without reading what is large.

    Args:
        artifact: of any kind; its files are not verified.

    Returns:
        Numbers and short texts by name, in the order to show them; empty for a kind that has no counts.

    Raises:
        ArtifactCorruptError: a file is missing, or is no table with the columns of its kind.
    """
    count = _COUNTING_FUNCTIONS.get(artifact.manifest.kind)
    return {} if count is None else count(artifact.path)


def read_short_table(artifact: Artifact) -> list[dict[str, Any]]:
    """Reads the table that is the result itself: metrics of an evaluation, decisions of a plan.

    Args:
        artifact: of any kind; its files are not verified.

    Returns:
        Its rows, with empty texts for what is not there; none for a kind whose tables are long.

    Raises:
        ArtifactCorruptError: the table is missing or damaged.
    """
    name = _SHORT_TABLES.get(artifact.manifest.kind)
    if name is None:
        return []
    table = _read_table(artifact.path / name)
    return [{key: "" if value is None else value for key, value in row.items()} for row in table.to_pylist()]


def count_nodes(nodes: NDArray[np.int64]) -> dict[str, int]:
    """Counts Gaussians by what they belong to.

    Args:
        nodes: [N] as ``SceneGraph.nodes`` has them: 0 static, 1 distant, from 2 on actors.

    Returns:
        Number of Gaussians by ``static``, ``distant`` and ``actor 0``, ``actor 1`` and so on, as far as there are any.

    >>> count_nodes(np.array([0, 0, 1, 3]))
    {'static': 2, 'distant': 1, 'actor 1': 1}
    """
    values, counts = np.unique(nodes, return_counts=True)
    return {name_node(int(value)): int(count) for value, count in zip(values, counts, strict=True)}


def name_node(node: int) -> str:
    """Names a node of the scene graph for readers.

    Args:
        node: a value of ``SceneGraph.nodes``.

    Returns:
        ``static``, ``distant`` or ``actor k``.

    >>> name_node(4)
    'actor 2'
    """
    return {_STATIC: "static", _DISTANT: "distant"}.get(node, f"actor {node - _DISTANT - 1}")


def read_columns(path: Path, names: list[str]) -> dict[str, NDArray[Any]]:
    """Reads some columns of a table as arrays.

    Args:
        path: a Parquet file.
        names: the columns.

    Returns:
        [N] by the column's name.

    Raises:
        ArtifactCorruptError: the file is missing or damaged, or lacks a column.
    """
    table = _read_table(path, names)
    return {name: _read_array(table.column(name)) for name in names}


def _read_array(column: pa.ChunkedArray) -> NDArray[Any]:
    import pyarrow as pa

    # Arrow's own to_numpy imports pandas, which takes longer than all the rest of a run that is in the store.
    array = column.combine_chunks()
    if array.null_count or not (pa.types.is_integer(array.type) or pa.types.is_floating(array.type)):
        return np.array(array.to_pylist())
    return np.from_dlpack(array)


def _read_table(path: Path, names: list[str] | None = None) -> pa.Table:
    import pyarrow as pa

    from genre_tasks.bounded_parquet import FOR_COLUMNS, FOR_ROWS, read_bounded_table

    try:
        table = read_bounded_table(path, FOR_COLUMNS if names else FOR_ROWS, names)
    except (OSError, ValueError, pa.ArrowException) as error:
        raise ArtifactCorruptError(f"The table does not decode ({error})", remedy=REMEDY, file=path) from error
    for name in names or ():
        # Arrow leaves out a column that the file does not have.
        if name not in table.column_names:
            raise ArtifactCorruptError(f"Column {name!r} is missing", remedy=REMEDY, file=path)
    return table


def _count_rows(path: Path) -> int:
    import pyarrow as pa
    import pyarrow.parquet as pq

    try:
        return int(pq.read_metadata(path).num_rows)
    except (OSError, ValueError, pa.ArrowException) as error:
        raise ArtifactCorruptError(f"The table does not decode ({error})", remedy=REMEDY, file=path) from error


def _count_chunk(folder: Path) -> dict[str, Any]:
    views = read_columns(folder / "views.parquet", ["camera", "role"])
    facts = read_columns(folder / "chunk.parquet", ["width_px", "height_px"])
    roles, counts = np.unique(views["role"].astype(str), return_counts=True)
    by_role = dict(zip(roles.tolist(), counts.tolist(), strict=True))
    return {
        "frames": _count_rows(folder / "frames.parquet"),
        "cameras": len(set(views["camera"].tolist())),
        "image": f"{facts['width_px'][0]} × {facts['height_px'][0]}",
        "source views": by_role.get("source", 0),
        "held-out views": by_role.get("heldout", 0),
        "LiDAR points": _count_rows(folder / "points.parquet"),
        "actors": _count_rows(folder / "actors.parquet"),
    }


def _count_reconstruction(folder: Path) -> dict[str, Any]:
    nodes = count_nodes(read_columns(folder / "gaussians.parquet", ["node"])["node"])
    actors = [count for name, count in nodes.items() if name.startswith("actor")]
    snapshots = folder / "snapshots"
    return {
        "Gaussians": sum(nodes.values()),
        "static": nodes.get("static", 0),
        "distant": nodes.get("distant", 0),
        "in actors": sum(actors),
        "actors": len(actors),
        "iterations": _count_rows(folder / "losses.parquet"),
        "snapshots": len(list(snapshots.glob("*.parquet"))) if snapshots.is_dir() else 0,
    }


def _count_views(folder: Path) -> dict[str, Any]:
    views = read_columns(folder / "views.parquet", ["camera", "shift_m"])
    shifts = sorted(set(views["shift_m"].tolist()))
    return {
        "views": len(views["shift_m"]),
        "cameras": len(set(views["camera"].tolist())),
        "shifts": ", ".join(f"{shift:+g} m" for shift in shifts),
    }


def _count_effects(folder: Path) -> dict[str, Any]:
    plan = read_columns(folder / "effects.parquet", ["name", "choice"])
    by_choice: dict[str, list[str]] = {}
    for name, choice in zip(plan["name"].tolist(), plan["choice"].tolist(), strict=True):
        by_choice.setdefault(choice, []).append(name)
    return {choice: ", ".join(by_choice[choice]) for choice in ("on", "mark", "off") if choice in by_choice}


def _count_evaluation(folder: Path) -> dict[str, Any]:
    pictures = folder / "pictures"
    return {
        "metrics": _count_rows(folder / "metrics.parquet"),
        "views with a truth": _count_rows(folder / "views.parquet"),
        "pictures": len(list(pictures.glob("*.png"))) if pictures.is_dir() else 0,
    }


_COUNTING_FUNCTIONS: dict[str, Callable[[Path], dict[str, Any]]] = {
    "chunk": _count_chunk,
    "reconstruction": _count_reconstruction,
    "novel_views": _count_views,
    "fixed_views": _count_views,
    "effects": _count_effects,
    "evaluation": _count_evaluation,
}
