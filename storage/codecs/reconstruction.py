"""Reconstruction ↔ ``gaussians.parquet``, ``actors.parquet``, ``losses.parquet``, ``snapshots/iteration_*.parquet``.

``rendering.parquet`` says how the scene is rendered, and is not there where nothing has to be said.
Seconds per iteration and culled counts are measurements: they live in the manifest and come back from there.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa

from genre_tasks.errors import ArtifactCorruptError, ConfigError
from genre_tasks.scene.gaussians import Gaussians
from genre_tasks.scene.graph import FIRST_ACTOR, ActorNode, SceneGraph
from genre_tasks.scene.results import Reconstruction
from storage.codecs.chunk import ACTORS, actor_columns, actor_fields
from storage.codecs.tables import REMEDY, array_of, checked, column, read_table, schema, write_table

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
GAUSSIANS = schema(
    "gaussians/1",
    [
        *(column(name, pa.float32(), note) for name, note in _ATTRIBUTES.items()),
        column("node", pa.int64(), "0 static, 1 distant (chunk coordinates), 2 + k actor k (box coordinates)"),
    ],
)
RENDERING = schema("rendering/1", [column("antialiased", pa.bool_(), "opacities make up for the blur of footprints")])
LOSSES = schema("losses/1", [column("loss", pa.float64(), "training loss of each iteration, in order")])
_SNAPSHOT = re.compile(r"iteration_(\d{4,})\.parquet")


def write(folder: Path, value: Reconstruction) -> None:
    """Write the final scene, its actors, the losses and the snapshots."""
    _write_scene(folder / "gaussians.parquet", value.scene)
    write_table(folder / "actors.parquet", ACTORS, actor_columns(value.scene.actors))
    write_table(folder / "losses.parquet", LOSSES, {"loss": np.array(value.losses, np.float64)})
    if value.scene.antialiased:
        write_table(folder / "rendering.parquet", RENDERING, {"antialiased": [True]})
    if value.snapshots:
        (folder / "snapshots").mkdir()
    for iteration, scene in sorted(value.snapshots.items()):
        if not _same_actors(scene.actors, value.scene.actors):
            raise ConfigError(
                f"The snapshot at iteration {iteration} has other actors than the scene",
                remedy="Fix the stage: snapshots share the scene's actors.",
            )
        _write_scene(folder / "snapshots" / f"iteration_{iteration:04d}.parquet", scene)


def read(folder: Path, measurements: Mapping[str, Any] | None = None) -> Reconstruction:
    """The reconstruction on the CPU; ``measurements`` are the manifest's."""
    rows = read_table(folder / "actors.parquet", ACTORS)[0].to_pylist()
    actors = tuple(ActorNode(**actor_fields(folder / "actors.parquet", row)) for row in rows)
    losses = read_table(folder / "losses.parquet", LOSSES)[0]
    measured = measurements or {}
    told = folder / "rendering.parquet"
    antialiased = told.exists() and bool(read_table(told, RENDERING)[0].column("antialiased")[0].as_py())
    return Reconstruction(
        scene=_read_scene(folder / "gaussians.parquet", actors, antialiased),
        losses=tuple(losses.column("loss").to_pylist()),
        snapshots={n: _read_scene(path, actors, antialiased) for n, path in sorted(_snapshots(folder))},
        seconds_per_iteration=tuple(measured.get("seconds_per_iteration", ())),
        culled=dict(measured.get("culled", {})),
    )


def measurements(value: Reconstruction) -> dict[str, Any]:
    """Seconds per iteration and culled counts."""
    return {"seconds_per_iteration": list(value.seconds_per_iteration), "culled": dict(value.culled)}


def _write_scene(path: Path, scene: SceneGraph) -> None:
    packed = scene.gaussians.packed().detach().cpu().numpy()
    checked(packed, f"gaussians of {path.name}", np.float32, (None, len(_ATTRIBUTES)))
    nodes = checked(scene.nodes.detach().cpu().numpy(), f"nodes of {path.name}", np.int64, (len(packed),))
    _check_nodes(nodes, len(scene.actors), lambda problem: ConfigError(problem, remedy="Fix the stage that made it."))
    columns = {name: packed[:, i] for i, name in enumerate(_ATTRIBUTES)}
    write_table(path, GAUSSIANS, {**columns, "node": nodes})


def _read_scene(path: Path, actors: tuple[ActorNode, ...], antialiased: bool) -> SceneGraph:
    import torch

    table = read_table(path, GAUSSIANS)[0]
    nodes = array_of(table, "node")
    _check_nodes(nodes, len(actors), lambda problem: ArtifactCorruptError(problem, remedy=REMEDY, file=path))
    names = list(_ATTRIBUTES)
    # Each attribute is made contiguous by itself: views into one packed tensor would be strided.
    parts = [torch.from_numpy(np.stack([array_of(table, n) for n in names[a:b]], 1)) for a, b in _RANGES]
    means, log_scales, quats, opacity, colors = parts
    gaussians = Gaussians(means, log_scales, quats, opacity[:, 0], colors)
    return SceneGraph(gaussians, torch.from_numpy(nodes), actors, antialiased)


_RANGES = ((0, 3), (3, 6), (6, 10), (10, 11), (11, 14))


def _check_nodes(nodes: Any, actors: int, error: Any) -> None:
    if len(nodes) and not (nodes.min() >= 0 and nodes.max() < FIRST_ACTOR + actors):
        raise error(f"Column 'node' holds {nodes.min()} … {nodes.max()}, but there are {actors} actors")


def _snapshots(folder: Path) -> list[tuple[int, Path]]:
    below = folder / "snapshots"
    found = []
    for path in below.iterdir() if below.is_dir() else ():
        match = _SNAPSHOT.fullmatch(path.name)
        if match is None:
            raise ArtifactCorruptError("The name is not of a snapshot", remedy=REMEDY, file=path)
        found.append((int(match[1]), path))
    return found


def _same_actors(a: tuple[ActorNode, ...], b: tuple[ActorNode, ...]) -> bool:
    return len(a) == len(b) and all(
        x is y
        or (
            (x.track_id, x.label, x.size_m) == (y.track_id, y.label, y.size_m)
            and np.array_equal(x.frames, y.frames)
            and np.array_equal(x.chunk_SE3_box, y.chunk_SE3_box)
        )
        for x, y in zip(a, b, strict=True)
    )
