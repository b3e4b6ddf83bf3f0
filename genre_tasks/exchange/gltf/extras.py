"""What glTF has no place for: the log's words and moments, under one name in ``extras``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any, TypeVar

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from genre_tasks.errors import InputError
from genre_tasks.exchange.gltf.document import EXTRAS_KEY, Matrix4, Number, Vector3
from genre_tasks.exchange.moments import Frame
from genre_tasks.exchange.types import ExchangeNode, ExchangeScene

LONGEST_WORD = 1000
"""Longer text is cut when it is written, and refused when it is read."""

_Word = Annotated[str, Field(max_length=LONGEST_WORD)]


class _Extras(BaseModel):
    model_config = ConfigDict(strict=True, frozen=True, extra="ignore")


class SceneExtras(_Extras):
    """Of the file as a whole.

    Attributes:
        frames: log frames of the moments.
        times_s: seconds of the moments, as precisely as the log has them; keyframes have them as float32.
        world_SE3_scene: the scene's place in the log's world, row by row.
        losses: sentences on what the scene lost before it was written.
    """

    frames: list[Frame] = []
    times_s: list[Number] = []
    world_SE3_scene: Matrix4 = np.eye(4).ravel().tolist()
    losses: list[_Word] = []


class NodeExtras(_Extras):
    """Of a node.

    Attributes:
        label: class of an actor, in the log's words.
        track_id: the log's name for it.
        size_m: length, width and height of its box.
        antialiased: whether its Gaussians were made with anti-aliasing.
        sh_degree: of its harmonics, which matters where it has no Gaussians.
    """

    label: _Word = ""
    track_id: _Word = ""
    size_m: Vector3 = [0.0, 0.0, 0.0]
    antialiased: bool | None = None
    sh_degree: Annotated[int, Field(ge=0, le=3)] = 0


_AnyExtras = TypeVar("_AnyExtras", SceneExtras, NodeExtras)


def describe_scene(scene: ExchangeScene) -> dict[str, Any]:
    """Gives a scene's extras as JSON.

    Args:
        scene: to be written.
    """
    extras = SceneExtras(
        frames=list(scene.frames),
        times_s=scene.times_s.tolist(),
        world_SE3_scene=scene.world_SE3_scene.ravel().tolist(),
        # Sentences name parts of files, whose names may be of any length.
        losses=[loss[:LONGEST_WORD] for loss in scene.losses],
    )
    return {EXTRAS_KEY: extras.model_dump()}


def describe_node(node: ExchangeNode, sh_degree: int) -> dict[str, Any]:
    """Gives a node's extras as JSON.

    Args:
        node: to be written.
        sh_degree: of what is written.
    """
    extras = NodeExtras(
        label=node.label[:LONGEST_WORD],
        track_id=node.track_id[:LONGEST_WORD],
        size_m=[float(size) for size in node.size_m],
        antialiased=node.cloud.antialiased,
        sh_degree=sh_degree,
    )
    return {EXTRAS_KEY: extras.model_dump()}


def parse_extras(path: Path, extras: Any, kind: type[_AnyExtras]) -> _AnyExtras | None:
    """Reads the extras of a file or a node.

    Args:
        path: of the file, for the error.
        extras: JSON.
        kind: what they describe.

    Returns:
        ``None`` where there are none of ours.

    Raises:
        InputError: they are ours, and something in them has another type or range.
    """
    if not isinstance(extras, dict) or EXTRAS_KEY not in extras:
        return None
    try:
        return kind.model_validate(extras[EXTRAS_KEY])
    except ValidationError as error:
        first = error.errors()[0]
        place = ".".join(str(part) for part in first["loc"])[:200]
        problem = f"the file's extras.{EXTRAS_KEY} do not fit: {place}: {first['msg']}"
        raise InputError(problem, remedy="Export it again, or remove these extras.", file=path) from error
