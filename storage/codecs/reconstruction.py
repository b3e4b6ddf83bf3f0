"""Reconstruction ↔ ``gaussians.parquet``, ``actors.parquet``, ``losses.parquet``, ``snapshots/iteration_*.parquet``.

Where Gaussians have spherical harmonics, ``harmonics/NAME.parquet`` holds those of each table ``NAME.parquet`` of
Gaussians. ``rendering.parquet`` is only there where the scene is rendered in another way than by default. Where actors
deform there are ``deformation.parquet``, and ``deformation/iteration_*.parquet`` of the snapshots.

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
from genre_tasks.scene.actor_node import ActorNode
from genre_tasks.scene.reconstruction import Reconstruction
from storage.codecs.actors import read_actors, write_actors
from storage.codecs.deformation import write_deformation
from storage.codecs.scene_tables import read_scene, write_scene
from storage.codecs.tables import REMEDY, column, read_table, schema, write_table

RENDERING = schema("rendering/1", [column("antialiased", pa.bool_(), "opacities make up for the blur of footprints")])
LOSSES = schema("losses/1", [column("loss", pa.float64(), "training loss of each iteration, in order")])
_SNAPSHOT = re.compile(r"iteration_(\d{4,})\.parquet")


def write(folder: Path, value: Reconstruction) -> None:
    """Writes the final scene, its actors, the losses and the snapshots.

    Args:
        folder: an empty folder.
        value: the reconstruction.

    Raises:
        ConfigError: an attribute has another dtype or shape, or a snapshot has other actors than the scene.
        NonFiniteError: an attribute is NaN or infinite.
    """
    write_scene(folder / "gaussians.parquet", value.scene)
    write_actors(folder / "actors.parquet", value.scene.actors)
    write_table(folder / "losses.parquet", LOSSES, {"loss": np.array(value.losses, np.float64)})
    # No file for the default, so that artifacts from before this setting keep their digests.
    if value.scene.antialiased:
        write_table(folder / "rendering.parquet", RENDERING, {"antialiased": [True]})
    if value.snapshots:
        (folder / "snapshots").mkdir()
    if value.scene.deformation is not None:
        write_deformation(folder / "deformation.parquet", value.scene.deformation)
        (folder / "deformation").mkdir()
    # Snapshots are stored without actors: they share the scene's, which are written once.
    for iteration, scene in sorted(value.snapshots.items()):
        if not _are_same_actors(scene.actors, value.scene.actors):
            raise ConfigError(
                f"The snapshot at iteration {iteration} has other actors than the scene",
                remedy="Fix the stage: snapshots share the scene's actors.",
            )
        name = f"iteration_{iteration:04d}.parquet"
        write_scene(folder / "snapshots" / name, scene)
        if scene.deformation is not None:
            write_deformation(folder / "deformation" / name, scene.deformation)


def read(folder: Path, measurements: Mapping[str, Any] | None = None) -> Reconstruction:
    """Reads a reconstruction.

    Args:
        folder: the folder that :func:`write` filled.
        measurements: ``seconds_per_iteration`` and ``culled`` from the manifest.

    Returns:
        The reconstruction on the CPU.

    Raises:
        ArtifactCorruptError: a table is damaged, or a file in ``snapshots`` is none.
    """
    actors = tuple(ActorNode(**actor) for actor in read_actors(folder / "actors.parquet"))
    losses = read_table(folder / "losses.parquet", LOSSES)[0]
    # A reader without the manifest, such as an export, still gets the scene.
    known = measurements or {}
    rendering = folder / "rendering.parquet"
    antialiased = rendering.exists() and bool(read_table(rendering, RENDERING)[0].column("antialiased")[0].as_py())
    return Reconstruction(
        scene=read_scene(folder / "gaussians.parquet", actors, antialiased, folder / "deformation.parquet"),
        losses=tuple(losses.column("loss").to_pylist()),
        snapshots={
            iteration: read_scene(path, actors, antialiased, folder / "deformation" / path.name)
            for iteration, path in sorted(_find_snapshots(folder))
        },
        seconds_per_iteration=tuple(known.get("seconds_per_iteration", ())),
        culled=dict(known.get("culled", {})),
    )


def measurements(value: Reconstruction) -> dict[str, Any]:
    """Selects what differs between runs of the same stage.

    Args:
        value: the reconstruction.

    Returns:
        ``seconds_per_iteration``, and ``culled``: how many Gaussians were not rendered, by reason.
    """
    return {"seconds_per_iteration": list(value.seconds_per_iteration), "culled": dict(value.culled)}


def _find_snapshots(folder: Path) -> list[tuple[int, Path]]:
    snapshots = folder / "snapshots"
    found = []
    for path in snapshots.iterdir() if snapshots.is_dir() else ():
        match = _SNAPSHOT.fullmatch(path.name)
        # A stray file is an error and not skipped, because a renamed snapshot would otherwise vanish from the curve.
        if match is None:
            raise ArtifactCorruptError("The name is not of a snapshot", remedy=REMEDY, file=path)
        found.append((int(match[1]), path))
    return found


def _are_same_actors(a: tuple[ActorNode, ...], b: tuple[ActorNode, ...]) -> bool:
    # Snapshots usually hold the very same objects, for which arrays need not be compared.
    return len(a) == len(b) and all(
        x is y
        or (
            (x.track_id, x.label, x.size_m) == (y.track_id, y.label, y.size_m)
            and np.array_equal(x.frames, y.frames)
            and np.array_equal(x.chunk_SE3_box, y.chunk_SE3_box)
        )
        for x, y in zip(a, b, strict=True)
    )
