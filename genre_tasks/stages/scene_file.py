"""A scene that another program made, as the start of a reconstruction: read, turned, scaled, put into a chunk."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

from genre_tasks.config import FilePlacement, InitialConfig
from genre_tasks.errors import InputError
from genre_tasks.exchange.clouds import transform_cloud
from genre_tasks.exchange.conversion import to_scene_graph
from genre_tasks.exchange.registry import find_format
from genre_tasks.exchange.types import ExchangeScene
from genre_tasks.logs.types import Float64
from genre_tasks.optimiser.state import LOG_SCALE_BOUNDS
from genre_tasks.scene.chunk import Chunk
from genre_tasks.scene.graph import DISTANT, SceneGraph
from genre_tasks.scene.rotations import quats_to_matrices_numpy
from genre_tasks.scene.transforms import compose_se3, distance_to_path


def load_initial_scene(config: InitialConfig, chunk: Chunk) -> SceneGraph:
    """Reads the file of Gaussians that a reconstruction starts from.

    Args:
        config: names the file, and says where it belongs.
        chunk: whose coordinates the scene is put into.

    Returns:
        The scene. What is farther from the path than ``max_range_m``, or larger than near Gaussians may be, belongs to
        the distant region.

    Raises:
        InputError: the file cannot be read, has no Gaussians or moving parts.
    """
    scene = read_placed_scene(str(config.scene), config.placement, chunk.world_SE3_chunk)
    means = scene.gaussians.means.numpy()
    is_far = torch.from_numpy(distance_to_path(means, chunk.chunk_SE3_ego) > config.max_range_m)
    # Near Gaussians are kept small by the optimiser, which would cut a sky of few large ones.
    is_large = scene.gaussians.log_scales.amax(1) > LOG_SCALE_BOUNDS[1]
    return replace(scene, nodes=torch.where(is_far | is_large, DISTANT, scene.nodes))


def read_placed_scene(file: str, placement: FilePlacement, world_SE3_chunk: Float64) -> SceneGraph:
    """Reads a file of Gaussians into the coordinates of a chunk.

    Args:
        file: in any format that can be read.
        placement: from its coordinates to the log's world.
        world_SE3_chunk: [4, 4] of the chunk.

    Returns:
        The scene, with spherical harmonics up to degree 3 where the file has any.

    Raises:
        InputError: the file cannot be read, has no Gaussians or moving parts.
    """
    path = Path(file)
    if not path.is_file():
        raise InputError("there is no such file of Gaussians", remedy="Correct the path of the scene.", file=path)
    read = find_format(path).read(path)
    moving = [node.name for node in read.nodes if node.motion is not None]
    if moving:
        raise InputError(
            f"the scene has {len(moving)} moving parts, such as {moving[0]}, and only what rests can be enhanced",
            remedy="Export it at one moment, without its actors.",
            file=path,
        )
    if not any(len(node.cloud) for node in read.nodes):
        raise InputError("the scene has no Gaussians", remedy="Export it again.", file=path)
    return to_scene_graph(_place(read, placement, world_SE3_chunk))


def _place(scene: ExchangeScene, placement: FilePlacement, world_SE3_chunk: Float64) -> ExchangeScene:
    """The scene in chunk coordinates: scaled in the file's axes first, then moved rigidly."""
    world_SE3_file = compose_se3(quats_to_matrices_numpy(np.array(placement.quat)), np.zeros(3))
    chunk_SE3_world = compose_se3(world_SE3_chunk[:3, :3].T, -world_SE3_chunk[:3, :3].T @ world_SE3_chunk[:3, 3])
    nodes = []
    for node in scene.nodes:
        cloud = replace(
            node.cloud,
            means=(node.cloud.means.astype(np.float64) * placement.scale).astype(np.float32),
            log_scales=node.cloud.log_scales + np.float32(math.log(placement.scale)),
        )
        nodes.append(replace(node, cloud=transform_cloud(cloud, chunk_SE3_world @ world_SE3_file)))
    return replace(scene, nodes=tuple(nodes), world_SE3_scene=world_SE3_chunk)
