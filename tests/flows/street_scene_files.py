"""A tiny street as any program would leave it: Gaussians, images with poses and points, in axes of their own."""

from __future__ import annotations

import functools
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

from flows.configuration import load_configuration
from genre_tasks.exchange.clouds import transform_cloud
from genre_tasks.exchange.conversion import pose_scene, to_exchange_scene
from genre_tasks.exchange.one_cloud import make_resting_scene
from genre_tasks.exchange.ply import PLY
from genre_tasks.exchange.types import SplatCloud
from genre_tasks.logs.registry import open_log
from genre_tasks.scene.chunk import Chunk
from genre_tasks.scene.graph import SceneGraph
from genre_tasks.scene.transforms import compose_se3
from genre_tasks.stages.ingest import ingest
from genre_tasks.stages.initial import initial
from tests.faults.small_run import LOG
from tests.logs.posed_images_folder import Y_DOWN, write_transforms

SIZE = ("ingest.width_px=64", "ingest.height_px=36")


def in_source_axes(cloud: SplatCloud) -> SplatCloud:
    """The street's Gaussians as the file of poses has the world: turned, and in units of 2.5 m."""
    turned = transform_cloud(cloud, compose_se3(Y_DOWN.rotation, np.zeros(3)))
    unit = np.float32(Y_DOWN.metres_per_unit)
    return replace(turned, means=turned.means / unit, log_scales=turned.log_scales - np.log(unit))


@functools.cache
def make_resting_street() -> tuple[Chunk, SceneGraph]:
    """The street's chunk and its initial scene, with everything at rest."""
    config = load_configuration("demo", settings=[*SIZE, "initial.max_points=3000", "initial.distant_count=300"])
    chunk = ingest(config.ingest, open_log(LOG), 0)
    scene = initial(config.initial, chunk).scene
    return chunk, replace(scene, actors=(), nodes=torch.zeros_like(scene.nodes))


def write_street(folder: Path) -> None:
    """``scene.ply``, ``points.ply``, ``transforms.json`` and images; a unit is 2.5 m."""
    chunk, scene = make_resting_street()
    write_transforms(folder, Y_DOWN, LOG)
    cloud = pose_scene(to_exchange_scene(scene, (), (), chunk.world_SE3_chunk, names={}), None)
    world = transform_cloud(cloud, chunk.world_SE3_chunk)
    PLY.write(folder / "scene.ply", make_resting_scene(in_source_axes(world)))
    points = (chunk.static.positions + chunk.world_SE3_chunk[:3, 3]) @ Y_DOWN.rotation.T / Y_DOWN.metres_per_unit
    header = f"ply\nformat ascii 1.0\nelement vertex {len(points)}\n"
    header += "property double x\nproperty double y\nproperty double z\nend_header\n"
    (folder / "points.ply").write_text(header + "\n".join(" ".join(map(repr, row)) for row in points.tolist()))
