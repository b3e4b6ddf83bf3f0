"""What was read of a stage as an exchange scene: a node for each field of Gaussians, in metres with z up."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydantic import TypeAdapter, ValidationError

from genre_tasks.errors import InputError
from genre_tasks.exchange.checks import check_finite_cloud
from genre_tasks.exchange.moments import Frame, is_rising
from genre_tasks.exchange.types import ExchangeNode, ExchangeScene, NodeMotion, SplatCloud
from genre_tasks.exchange.usd import names
from genre_tasks.exchange.usd.color_spaces import describe_color_losses
from genre_tasks.exchange.usd.particle_fields import FieldArrays
from genre_tasks.exchange.usd.similarity import place_cloud, scale_cloud, split_similarity
from genre_tasks.logs.types import Float64

_Z_UP_FROM_Y_UP = np.array([[1.0, 0, 0, 0], [0, 0, -1, 0], [0, 1, 0, 0], [0, 0, 0, 1]])

_SCALE_TOLERANCE = 1e-4

_FRAMES = TypeAdapter(tuple[Frame, ...])


def make_scene(stage: Mapping[str, Any], arrays: Mapping[str, Any], file: Path) -> ExchangeScene:
    """Makes a scene.

    Args:
        stage: JSON values of :mod:`genre_tasks.exchange.usd.stage_dump`.
        arrays: its arrays.
        file: the file that the user named.

    Returns:
        The scene in metres with z up.

    Raises:
        InputError: a field is damaged, or placed in a way that Gaussians cannot follow.
    """
    scene = _make_moments(stage, file)
    scene_from_stage = _find_axes(stage, file)
    nodes = []
    taken: set[str] = set()
    hidden = 0
    color_losses: dict[str, None] = {}
    for k, field in enumerate(stage["fields"]):
        prefix = f"{k}/"
        mine = {name.removeprefix(prefix): values for name, values in arrays.items() if name.startswith(prefix)}
        if not field["moves"] and not mine[names.SHOWN].any():
            hidden += 1
            continue
        node = _make_node(field, mine, scene_from_stage, file)
        check_finite_cloud(file, node.cloud)
        nodes.append(replace(node, name=_choose_name(node.name, taken)))
        has_harmonics = names.COEFFICIENTS in mine
        color_losses |= dict.fromkeys(describe_color_losses(field["color_space"], has_harmonics=has_harmonics))
    if not stage["scene"] and not any(node.motion for node in nodes):
        scene = replace(scene, times_s=np.zeros(0))
    losses = [*scene.losses, *stage["losses"], *color_losses]
    if hidden:
        losses.append(f"Invisible are {hidden} fields of Gaussians, which are not read.")
    return replace(scene, nodes=tuple(nodes), losses=tuple(losses))


def _make_moments(stage: Mapping[str, Any], file: Path) -> ExchangeScene:
    """A scene without nodes: its times, and for files of ours the rest of what is not in a node."""
    ours = stage["scene"]
    codes = np.array(stage["codes"], np.float64)
    rate = stage["rate"]
    if not (np.isfinite(rate) and rate > 0):
        raise _damage(f"the stage has {rate} time codes a second", file)
    times_s = (codes - codes[:1]) / rate
    if not ours:
        return ExchangeScene((), times_s, (), np.eye(4))
    times_s = _to_numbers(ours.get(names.TIMES_S, ()), "times", file).reshape(-1)
    frames = _to_frames(ours.get(names.FRAMES, ()), file)
    if not is_rising(times_s) or (frames and len(frames) != len(times_s)):
        raise _damage("the scene's times do not rise, or are not as many as its frames", file)
    world = _to_numbers(ours.get(names.WORLD_SE3_SCENE, np.eye(4)), "place in the world", file)
    if world.shape != (4, 4) or not np.isfinite(world).all():
        raise _damage("the scene's place in the world is no finite matrix", file)
    losses = tuple(str(loss) for loss in ours.get(names.LOSSES, ()))
    return ExchangeScene((), times_s, frames, world.T.copy(), losses)


def _to_numbers(values: Any, what: str, file: Path) -> Float64:
    """What an entry of ours should be: anybody may have put other values there."""
    try:
        return np.array(values, np.float64)
    except (TypeError, ValueError) as error:
        raise _damage(f"the scene's {what} is no array of numbers", file) from error


def _to_frames(values: Any, file: Path) -> tuple[int, ...]:
    try:
        return _FRAMES.validate_python(values)
    except ValidationError as error:
        raise _damage(f"the scene's frames are no numbers of log frames: {error.errors()[0]['msg']}", file) from error


def _find_axes(stage: Mapping[str, Any], file: Path) -> Float64:
    scale = stage["metres_per_unit"]
    if not (np.isfinite(scale) and scale > 0):
        raise _damage(f"the stage has {scale} metres a unit", file)
    turned = _Z_UP_FROM_Y_UP if stage["up_axis"] == "Y" else np.eye(4)
    axes: Float64 = turned @ np.diag([scale, scale, scale, 1.0])
    return axes


def _make_node(
    field: Mapping[str, Any], arrays: Mapping[str, Any], scene_from_stage: Float64, file: Path
) -> ExchangeNode:
    path = field["path"]
    node = field["node"]
    cloud = FieldArrays(arrays, field["degree"], field["color_space"], path, file).to_cloud()
    cloud = replace(cloud, antialiased=node.get(names.ANTIALIASED))
    matrices = scene_from_stage @ arrays[names.MATRICES]
    if not np.isfinite(matrices).all():
        raise _damage(f"the place of {path} is not finite", file)
    motion = None
    if field["moves"]:
        cloud, motion = _move_cloud(cloud, matrices, arrays[names.SHOWN], path, file)
    else:
        cloud = place_cloud(cloud, matrices[0], path, file)
    size = _to_numbers(node.get(names.SIZE_M, (0.0, 0.0, 0.0)), "size of a node", file)
    if size.shape != (3,) or not np.isfinite(size).all():
        raise _damage(f"the size of {path} is not three finite numbers", file)
    return ExchangeNode(
        # Where the file has no name of ours, a name fit for a file's name: of letters, digits and underscores.
        name=node.get(names.NAME) or "-".join(path.strip("/").split("/")),
        cloud=cloud,
        motion=motion,
        label=node.get(names.LABEL, ""),
        track_id=node.get(names.TRACK_ID, ""),
        size_m=(float(size[0]), float(size[1]), float(size[2])),
    )


def _move_cloud(
    cloud: SplatCloud, matrices: Float64, present: NDArray[np.bool_], path: str, file: Path
) -> tuple[SplatCloud, NodeMotion]:
    """The cloud in the node's own coordinates in metres, and where the node is."""
    poses = np.broadcast_to(np.eye(4), matrices.shape).copy()
    scales = []
    for row in np.flatnonzero(present):
        scale, poses[row] = split_similarity(matrices[row], path, file)
        scales.append(scale)
    if scales and max(scales) - min(scales) > _SCALE_TOLERANCE * max(scales):
        raise InputError(
            f"the node {path} grows or shrinks over time",
            remedy="Gaussians of a node keep their size: give it one scale.",
            file=file,
        )
    return scale_cloud(cloud, float(np.median(scales)) if scales else 1.0), NodeMotion(poses, present)


def _choose_name(name: str, taken: set[str]) -> str:
    number = 2
    free = name
    while free in taken:
        free = f"{name}-{number}"
        number += 1
    taken.add(free)
    return free


def _damage(problem: str, file: Path) -> InputError:
    return InputError(problem, remedy="Export the scene again.", file=file)
