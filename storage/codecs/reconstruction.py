"""Reconstruction ↔ ``gaussians.parquet``, ``actors.parquet``, ``losses.parquet``, ``snapshots/iteration_*.parquet``.

Where Gaussians have harmonics, ``harmonics/NAME.parquet`` holds those of each table ``NAME.parquet`` of Gaussians.
``rendering.parquet`` says how the scene is rendered, and is not there where nothing has to be said.
Where actors deform: ``deformation.parquet``, and ``deformation/iteration_*.parquet`` of the snapshots.

Seconds per iteration and culled counts are measurements: they live in the manifest and come back from there.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pyarrow as pa

from genre_tasks.errors import ArtifactCorruptError, ConfigError
from genre_tasks.scene.actor_node import ActorNode
from genre_tasks.scene.gaussians import Gaussians
from genre_tasks.scene.graph import COUNTS, DEGREE, FIRST_ACTOR, SceneGraph
from genre_tasks.scene.reconstruction import Reconstruction
from storage.codecs.chunk import ACTORS, actor_columns, actor_fields
from storage.codecs.tables import REMEDY, array_of, checked, column, read_table, schema, write_table

if TYPE_CHECKING:
    from torch import Tensor

    from genre_tasks.scene.deformation import Deformation

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
_WAVES = tuple(f"{channel}_{k}" for k in range(1, COUNTS[DEGREE] + 1) for channel in ("red", "green", "blue"))
HARMONICS = schema(
    f"harmonics/{DEGREE}", [column(n, pa.float32(), "of 3DGS's real spherical harmonic of that number") for n in _WAVES]
)
LOSSES = schema("losses/1", [column("loss", pa.float64(), "training loss of each iteration, in order")])
DEFORMATION = schema(
    "deformation/1",
    [
        column("actor", pa.int64(), "row of actors.parquet"),
        column("frame", pa.int64(), "frame of the log"),
        column("known", pa.bool_(), "false: in between in time, whatever the offsets"),
        column("offsets", pa.list_(pa.float32()), "metres in box axes, x y z of each control point, z counts up first"),
    ],
)
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
    if value.scene.deformation is not None:
        _write_deformation(folder / "deformation.parquet", value.scene.deformation)
        (folder / "deformation").mkdir()
    for iteration, scene in sorted(value.snapshots.items()):
        if not _same_actors(scene.actors, value.scene.actors):
            raise ConfigError(
                f"The snapshot at iteration {iteration} has other actors than the scene",
                remedy="Fix the stage: snapshots share the scene's actors.",
            )
        name = f"iteration_{iteration:04d}.parquet"
        _write_scene(folder / "snapshots" / name, scene)
        if scene.deformation is not None:
            _write_deformation(folder / "deformation" / name, scene.deformation)


def read(folder: Path, measurements: Mapping[str, Any] | None = None) -> Reconstruction:
    """The reconstruction on the CPU; ``measurements`` are the manifest's."""
    rows = read_table(folder / "actors.parquet", ACTORS)[0].to_pylist()
    actors = tuple(ActorNode(**actor_fields(folder / "actors.parquet", row)) for row in rows)
    losses = read_table(folder / "losses.parquet", LOSSES)[0]
    measured = measurements or {}
    told = folder / "rendering.parquet"
    antialiased = told.exists() and bool(read_table(told, RENDERING)[0].column("antialiased")[0].as_py())
    return Reconstruction(
        scene=_read_scene(folder / "gaussians.parquet", actors, antialiased, folder / "deformation.parquet"),
        losses=tuple(losses.column("loss").to_pylist()),
        snapshots={
            n: _read_scene(path, actors, antialiased, folder / "deformation" / path.name)
            for n, path in sorted(_snapshots(folder))
        },
        seconds_per_iteration=tuple(measured.get("seconds_per_iteration", ())),
        culled=dict(measured.get("culled", {})),
    )


def measurements(value: Reconstruction) -> dict[str, Any]:
    """Where actors deform: ``deformation.parquet``, and ``deformation/iteration_*.parquet`` of the snapshots.

    Seconds per iteration and culled counts."""
    return {"seconds_per_iteration": list(value.seconds_per_iteration), "culled": dict(value.culled)}


def _write_scene(path: Path, scene: SceneGraph) -> None:
    packed = scene.gaussians.packed().detach().cpu().numpy()
    checked(packed, f"gaussians of {path.name}", np.float32, (None, len(_ATTRIBUTES)))
    nodes = checked(scene.nodes.detach().cpu().numpy(), f"nodes of {path.name}", np.int64, (len(packed),))
    _check_nodes(nodes, len(scene.actors), lambda problem: ConfigError(problem, remedy="Fix the stage that made it."))
    columns = {name: packed[:, i] for i, name in enumerate(_ATTRIBUTES)}
    write_table(path, GAUSSIANS, {**columns, "node": nodes})
    if scene.harmonics is not None:
        waves = scene.harmonics.detach().cpu().numpy()
        checked(waves, f"harmonics of {path.name}", np.float32, (len(packed), COUNTS[DEGREE], 3))
        at = _harmonics_of(path)
        at.parent.mkdir(exist_ok=True)
        flat = waves.reshape(len(waves), -1)
        write_table(at, HARMONICS, {name: flat[:, i] for i, name in enumerate(_WAVES)})


def _harmonics_of(path: Path) -> Path:
    root = path.parent.parent if path.parent.name == "snapshots" else path.parent
    return root / "harmonics" / path.name


def _read_harmonics(path: Path, count: int) -> Tensor | None:
    """[N, K, 3], ``None`` where the artifact has none."""
    import torch

    if not path.parent.is_dir():
        return None
    table = read_table(path, HARMONICS)[0]
    if table.num_rows != count:
        raise ArtifactCorruptError(
            f"The table has {table.num_rows} rows for {count} Gaussians", remedy=REMEDY, file=path
        )
    return torch.from_numpy(np.stack([array_of(table, n) for n in _WAVES], 1).reshape(count, COUNTS[DEGREE], 3))


def _write_deformation(path: Path, deformation: Deformation) -> None:
    shape = len(deformation.actors), len(deformation.frames)
    offsets = deformation.offsets.detach().cpu().numpy()
    checked(offsets, f"offsets of {path.name}", np.float32, (*shape, None, 3))
    columns = {
        "actor": np.repeat(np.array(deformation.actors, np.int64), shape[1]),
        "frame": np.tile(np.array(deformation.frames, np.int64), shape[0]),
        "known": deformation.known.ravel(),
        "offsets": offsets.reshape(shape[0] * shape[1], -1).tolist(),
    }
    write_table(path, DEFORMATION, columns)


def _read_deformation(path: Path, paths: tuple[ActorNode, ...]) -> Deformation | None:
    """``None`` where there is no such file: actors are rigid."""
    if not path.exists():
        return None
    import torch

    from genre_tasks.scene.deformation import NODES, Deformation

    table = read_table(path, DEFORMATION)[0]
    actors, frames = (tuple(dict.fromkeys(table.column(n).to_pylist())) for n in ("actor", "frame"))
    values = table.column("offsets").to_pylist()
    sound = table.num_rows == len(actors) * len(frames) and all(len(v) == 3 * NODES for v in values)
    if not sound or any(not 0 <= k < len(paths) for k in actors):
        problem = f"{table.num_rows} rows do not give {len(actors)} of {len(paths)} actors at {len(frames)} frames"
        raise ArtifactCorruptError(problem, remedy=REMEDY, file=path)
    zero = Deformation.none(paths, actors, frames)
    known = np.array(table.column("known").to_pylist(), bool).reshape(len(actors), len(frames))
    offsets = torch.tensor(values, dtype=torch.float32).reshape(zero.offsets.shape)
    return replace(zero, known=known, offsets=offsets)


def _read_scene(path: Path, actors: tuple[ActorNode, ...], antialiased: bool, deformation: Path) -> SceneGraph:
    import torch

    table = read_table(path, GAUSSIANS)[0]
    nodes = array_of(table, "node")
    _check_nodes(nodes, len(actors), lambda problem: ArtifactCorruptError(problem, remedy=REMEDY, file=path))
    names = list(_ATTRIBUTES)
    # Each attribute is made contiguous by itself: views into one packed tensor would be strided.
    parts = [torch.from_numpy(np.stack([array_of(table, n) for n in names[a:b]], 1)) for a, b in _RANGES]
    means, log_scales, quats, opacity, colors = parts
    gaussians = Gaussians(means, log_scales, quats, opacity[:, 0], colors)
    waves, bent = _read_harmonics(_harmonics_of(path), len(nodes)), _read_deformation(deformation, actors)
    return SceneGraph(gaussians, torch.from_numpy(nodes), actors, antialiased, bent, waves)


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
