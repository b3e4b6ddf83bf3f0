"""How two scenes differ in their Gaussians: counts by node, what moved, what came and what went."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from storage.contents import name_node, read_columns

_ACTOR = "actor "
_NEAR_M = 0.1
"""A Gaussian without any of the other scene in so many metres is new, or gone."""
_NEAR_DISTANT_M = 2.0
"""The same in the distant region, whose Gaussians are as far apart as that."""
_MOST_QUERIES = 20_000
"""So many Gaussians of a node are looked up, at equal distances in its table; more would only take longer."""
_COLUMNS = ("x", "y", "z", "red", "green", "blue", "logit_opacity", "node")


def compare_gaussians(a: Path, b: Path) -> list[dict[str, Any]]:
    """Compares two scenes node by node.

    Args:
        a: folder of an artifact of the kind ``reconstruction``.
        b: the same of the second.

    Returns:
        A row for each node: both counts; where they match, how far Gaussians moved row by row (median, 95 % and
        maximum), and their mean change of colour and opacity; and the fractions of B that are new and of A that are
        gone, that is without any Gaussian of the other near by.

    Raises:
        ArtifactCorruptError: a table is damaged.
    """
    nodes_a = _read_nodes(a)
    nodes_b = _read_nodes(b)
    return [_compare_node(name, nodes_a.get(name), nodes_b.get(name)) for name in dict.fromkeys([*nodes_a, *nodes_b])]


def _read_nodes(folder: Path) -> dict[str, NDArray[np.float64]]:
    """[N, 7] of each node, by its name: mean, colour, logit of opacity."""
    columns = read_columns(folder / "gaussians.parquet", list(_COLUMNS))
    tracks = read_columns(folder / "actors.parquet", ["track_id"])["track_id"].tolist()
    packed = np.stack([columns[name].astype(np.float64) for name in _COLUMNS[:-1]], 1)
    nodes = {}
    for node in np.unique(columns["node"]):
        name = name_node(int(node))
        # By the track, because the order of actors may differ between scenes.
        if name.startswith(_ACTOR):
            name = f"{_ACTOR}{tracks[int(name.removeprefix(_ACTOR))]}"
        nodes[name] = packed[columns["node"] == node]
    return nodes


def _compare_node(name: str, a: NDArray[np.float64] | None, b: NDArray[np.float64] | None) -> dict[str, Any]:
    count_a = 0 if a is None else len(a)
    count_b = 0 if b is None else len(b)
    row: dict[str, Any] = {
        "node": name,
        "A": count_a,
        "B": count_b,
        "B − A": count_b - count_a,
        "moved, median m": "",
        "95 % m": "",
        "most m": "",
        "colour": "",
        "opacity": "",
        "new in B": "",
        "gone from A": "",
    }
    if a is None or b is None:
        return row
    if count_a == count_b:
        moved = np.linalg.norm(a[:, :3] - b[:, :3], axis=1)
        row["moved, median m"] = float(np.median(moved))
        row["95 % m"] = float(np.percentile(moved, 95))
        row["most m"] = float(moved.max())
        row["colour"] = float(np.abs(a[:, 3:6] - b[:, 3:6]).mean())
        row["opacity"] = float(np.abs(_sigmoid(a[:, 6]) - _sigmoid(b[:, 6])).mean())
    near_m = _NEAR_DISTANT_M if name == "distant" else _NEAR_M
    row["new in B"] = f"{_fraction_without(b, a, near_m):.1%}"
    row["gone from A"] = f"{_fraction_without(a, b, near_m):.1%}"
    return row


def _fraction_without(some: NDArray[np.float64], others: NDArray[np.float64], near_m: float) -> float:
    """The fraction of ``some`` without any of ``others`` in ``near_m``."""
    from scipy.spatial import cKDTree

    asked = some[:: max(1, len(some) // _MOST_QUERIES), :3]
    distances, _ = cKDTree(others[:, :3]).query(asked, distance_upper_bound=near_m)
    return float(np.isinf(distances).mean())


def _sigmoid(logits: NDArray[np.float64]) -> NDArray[np.float64]:
    return 1 / (1 + np.exp(-logits))
