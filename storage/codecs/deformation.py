"""The table of how actors deform, a part of the codec of reconstructions."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pyarrow as pa

from genre_tasks.errors import ArtifactCorruptError
from storage.codecs.tables import REMEDY, check_array, column, read_table, schema, write_table
from storage.codecs.view_columns import FRAME

if TYPE_CHECKING:
    from genre_tasks.scene.actor_node import ActorNode
    from genre_tasks.scene.deformation import Deformation

DEFORMATION = schema(
    "deformation/1",
    [
        column("actor", pa.int64(), "row of actors.parquet"),
        FRAME,
        column("known", pa.bool_(), "false: in between in time, whatever the offsets"),
        column("offsets", pa.list_(pa.float32()), "metres in box axes, x y z of each control point, z counts up first"),
    ],
)


def write_deformation(path: Path, deformation: Deformation) -> None:
    """Writes the offsets of the control points, a row for each actor at each frame.

    Args:
        path: the new file.
        deformation: offsets [A, F, NODES, 3] of A actors at F frames.

    Raises:
        ConfigError: the offsets have another dtype or shape.
        NonFiniteError: an offset is NaN or infinite.
    """
    actor_count = len(deformation.actors)
    frame_count = len(deformation.frames)
    offsets = deformation.offsets.detach().cpu().numpy()
    check_array(offsets, f"offsets of {path.name}", np.float32, (actor_count, frame_count, None, 3))
    # Row order is actor by actor, frame by frame: reshaping restores the array without a sort.
    columns = {
        "actor": np.repeat(np.array(deformation.actors, np.int64), frame_count),
        "frame": np.tile(np.array(deformation.frames, np.int64), actor_count),
        "known": deformation.known.ravel(),
        "offsets": offsets.reshape(actor_count * frame_count, -1).tolist(),
    }
    write_table(path, DEFORMATION, columns)


def read_deformation(path: Path, nodes: tuple[ActorNode, ...]) -> Deformation | None:
    """Reads what :func:`write_deformation` wrote.

    Args:
        path: the file.
        nodes: the scene's actors, whose boxes the control points lie in.

    Returns:
        The deformation, or ``None`` where there is no file: actors are rigid.

    Raises:
        ArtifactCorruptError: the table is damaged, or its rows are not every actor at every frame.
    """
    if not path.exists():
        return None
    import torch

    from genre_tasks.scene.deformation import NODES, Deformation

    table = read_table(path, DEFORMATION)[0]
    actors = tuple(dict.fromkeys(table.column("actor").to_pylist()))
    frames = tuple(dict.fromkeys(table.column("frame").to_pylist()))
    values = table.column("offsets").to_pylist()
    is_complete = table.num_rows == len(actors) * len(frames) and all(len(v) == 3 * NODES for v in values)
    if not is_complete or any(not 0 <= k < len(nodes) for k in actors):
        problem = f"{table.num_rows} rows do not give {len(actors)} of {len(nodes)} actors at {len(frames)} frames"
        raise ArtifactCorruptError(problem, remedy=REMEDY, file=path)
    # Sizes of the control grids follow from the actors' boxes, so a deformation of zeros already has them.
    zero = Deformation.zero(nodes, actors, frames)
    known = np.array(table.column("known").to_pylist(), bool).reshape(len(actors), len(frames))
    offsets = torch.tensor(values, dtype=torch.float32).reshape(zero.offsets.shape)
    return replace(zero, known=known, offsets=offsets)
