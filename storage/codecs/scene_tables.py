"""The tables of one scene graph: its Gaussians and, where it has any, their spherical harmonics."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from numpy.typing import NDArray

from genre_tasks.errors import ArtifactCorruptError, ConfigError, GenreError
from genre_tasks.scene.actor_node import ActorNode
from genre_tasks.scene.gaussians import Gaussians
from genre_tasks.scene.graph import DEFAULT_SH_DEGREE, FIRST_ACTOR, SH_COUNTS, SceneGraph
from storage.codecs.deformation import read_deformation
from storage.codecs.tables import REMEDY, check_array, column, column_array, read_table, schema, write_table

if TYPE_CHECKING:
    from torch import Tensor

# Stored as they are optimised, with logarithms and logits: activating and inverting would lose bits.
_ATTRIBUTES = {
    "x": "metres",
    "y": "metres",
    "z": "metres",
    "log_scale_x": "natural logarithm of metres",
    "log_scale_y": "natural logarithm of metres",
    "log_scale_z": "natural logarithm of metres",
    "quat_w": "need not be unit",
    "quat_x": "need not be unit",
    "quat_y": "need not be unit",
    "quat_z": "need not be unit",
    "logit_opacity": "logit",
    "red": "sRGB, nominally in [0, 1]",
    "green": "sRGB, nominally in [0, 1]",
    "blue": "sRGB, nominally in [0, 1]",
}
_ATTRIBUTE_COLUMNS = {
    "means": slice(0, 3),
    "log_scales": slice(3, 6),
    "quats": slice(6, 10),
    "logit_opacities": slice(10, 11),
    "colors": slice(11, 14),
}
GAUSSIANS = schema(
    "gaussians/1",
    [
        *(column(name, pa.float32(), note) for name, note in _ATTRIBUTES.items()),
        column("node", pa.int64(), "0 static, 1 distant (chunk coordinates), 2 + k actor k (box coordinates)"),
    ],
)


def _list_sh_columns(degree: int) -> tuple[str, ...]:
    return tuple(f"{c}_{k}" for k in range(1, SH_COUNTS[degree] + 1) for c in ("red", "green", "blue"))


# A degree each: reconstructions have the default one, scenes of other programs any.
SPHERICAL_HARMONICS = {
    degree: schema(
        f"harmonics/{degree}",
        [
            column(name, pa.float32(), "of 3DGS's real spherical harmonic of that number")
            for name in _list_sh_columns(degree)
        ],
    )
    for degree in SH_COUNTS
}


def write_scene(path: Path, scene: SceneGraph) -> None:
    """Writes a scene's Gaussians, and its spherical harmonics to a folder ``harmonics`` where it has any.

    Args:
        path: the new table: ``gaussians.parquet``, or one in ``snapshots``.
        scene: the scene graph, on any device.

    Raises:
        ConfigError: an attribute has another dtype or shape, or a Gaussian belongs to no node.
        NonFiniteError: an attribute is NaN or infinite.
    """
    packed = scene.gaussians.pack().detach().cpu().numpy()
    check_array(packed, f"gaussians of {path.name}", np.float32, (None, len(_ATTRIBUTES)))
    # Nodes and attributes come from different tensors, so their lengths may differ.
    nodes = check_array(scene.nodes.detach().cpu().numpy(), f"nodes of {path.name}", np.int64, (len(packed),))
    _check_nodes(nodes, len(scene.actors), lambda problem: ConfigError(problem, remedy="Fix the stage that made it."))
    columns = {name: packed[:, i] for i, name in enumerate(_ATTRIBUTES)}
    write_table(path, GAUSSIANS, {**columns, "node": nodes})
    if scene.spherical_harmonics is not None:
        coefficients = scene.spherical_harmonics.detach().cpu().numpy()
        degrees = {count: degree for degree, count in SH_COUNTS.items()}
        degree = degrees.get(coefficients.shape[1] if coefficients.ndim == 3 else 0, DEFAULT_SH_DEGREE)
        check_array(coefficients, f"harmonics of {path.name}", np.float32, (len(packed), SH_COUNTS[degree], 3))
        sh_path = _sh_path(path)
        sh_path.parent.mkdir(exist_ok=True)
        flat = coefficients.reshape(len(coefficients), -1)
        columns = {name: flat[:, i] for i, name in enumerate(_list_sh_columns(degree))}
        write_table(sh_path, SPHERICAL_HARMONICS[degree], columns)


def read_scene(path: Path, actors: tuple[ActorNode, ...], antialiased: bool, deformation_path: Path) -> SceneGraph:
    """Reads what :func:`write_scene` wrote, and the actors' deformation.

    Args:
        path: the table of Gaussians.
        actors: the scene's actors.
        antialiased: whether the scene's opacities make up for the blur of footprints.
        deformation_path: the table of the deformation, which need not exist.

    Returns:
        The scene graph on the CPU.

    Raises:
        ArtifactCorruptError: a table is damaged, or a Gaussian belongs to no node.
    """
    import torch

    table = read_table(path, GAUSSIANS)[0]
    nodes = column_array(table, "node")
    _check_nodes(nodes, len(actors), lambda problem: ArtifactCorruptError(problem, remedy=REMEDY, file=path))
    names = list(_ATTRIBUTES)
    # Each attribute is made contiguous by itself: views into one packed tensor would be strided.
    attributes = {
        attribute: torch.from_numpy(np.stack([column_array(table, n) for n in names[columns]], 1))
        for attribute, columns in _ATTRIBUTE_COLUMNS.items()
    }
    # All attributes are stacked alike, but this one has no second dimension.
    attributes["logit_opacities"] = attributes["logit_opacities"][:, 0]
    return SceneGraph(
        Gaussians(**attributes),
        torch.from_numpy(nodes),
        actors,
        antialiased,
        read_deformation(deformation_path, actors),
        _read_spherical_harmonics(_sh_path(path), len(nodes)),
    )


def _sh_path(path: Path) -> Path:
    # One folder for all harmonics, beside the snapshots and not inside them, where every file has to be a snapshot.
    root = path.parent.parent if path.parent.name == "snapshots" else path.parent
    return root / "harmonics" / path.name


def _read_spherical_harmonics(path: Path, count: int) -> Tensor | None:
    """Coefficients [N, K, 3]; ``None`` where the artifact has none."""
    import torch

    # The folder decides: with it, a table that is missing is damage.
    if not path.parent.is_dir():
        return None
    degree = _find_sh_degree(path)
    table = read_table(path, SPHERICAL_HARMONICS[degree])[0]
    # Two tables that do not fit would shift colours from one Gaussian to another.
    if table.num_rows != count:
        raise ArtifactCorruptError(
            f"The table has {table.num_rows} rows for {count} Gaussians", remedy=REMEDY, file=path
        )
    flat = np.stack([column_array(table, n) for n in _list_sh_columns(degree)], 1)
    return torch.from_numpy(flat.reshape(count, SH_COUNTS[degree], 3))


def _find_sh_degree(path: Path) -> int:
    """The degree that a table's number of columns is of; the default one where the table is damaged or none."""
    try:
        columns = len(pq.read_schema(path).names)
    except (pa.ArrowException, OSError, ValueError):
        # Reading it raises the error that names what is wrong.
        return DEFAULT_SH_DEGREE
    return next((degree for degree, count in SH_COUNTS.items() if 3 * count == columns), DEFAULT_SH_DEGREE)


def _check_nodes(nodes: NDArray[np.int64], actor_count: int, make_error: Callable[[str], GenreError]) -> None:
    if len(nodes) and not (nodes.min() >= 0 and nodes.max() < FIRST_ACTOR + actor_count):
        raise make_error(f"Column 'node' holds {nodes.min()} … {nodes.max()}, but there are {actor_count} actors")
