"""Labelled images of the fake street: recorded ones, and the true images of moved cameras in the place of renders."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np

from genre_tasks.config import IngestConfig
from genre_tasks.logs.types import Float32, Float64, Lens
from genre_tasks.scene.chunk import Chunk
from genre_tasks.scene.novel_poses import place_novel_views
from genre_tasks.stages.ingest import ingest
from genre_tasks.training_sets.label_boxes import LogLabeller
from genre_tasks.training_sets.labelled_images import LabelledImage
from tests.fakes import FakeCar, FakeLog, cast

CARS = (
    FakeCar("mover", 6.0, 3.5, speed_mps=6.0),
    FakeCar("parked", 14.0, -4.0, yaw_rad=0.4),
    FakeCar("far", 30.0, 0.0),
)
LOG = FakeLog(frame_count=4, cars=CARS, world_offset_m=(4_000_000.0, -70_000.0, 12.0))
LENS = Lens(fx_px=100.0, fy_px=100.0, cx_px=50.0, cy_px=50.0, width_px=100, height_px=100)
FORWARD = np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]])
"""camera_R_box of an object that drives away from the camera."""


@cache
def chunk_of(log: FakeLog = LOG) -> Chunk:
    """The log's first chunk at its own resolution."""
    return ingest(IngestConfig(width_px=log.width_px, height_px=log.height_px, source_every=1), log, 0)


def true_depth(log: FakeLog, world_SE3_camera: Float64, lens: Lens, frame: int) -> Float32:
    """[H, W] metres along the camera's axis, 0 for the sky."""
    u, v = np.meshgrid(np.arange(lens.width_px) + 0.5, np.arange(lens.height_px) + 0.5)
    rays = np.stack([(u - lens.cx_px) / lens.fx_px, (v - lens.cy_px) / lens.fy_px, np.ones_like(u)], -1)
    origin = world_SE3_camera[:3, 3] - np.asarray(log.world_offset_m)
    # Rays one metre long along the axis: their lengths are depths.
    depth, _ = cast(origin, rays.reshape(-1, 3) @ world_SE3_camera[:3, :3].T, log.cars, 0.1 * frame)
    return np.where(np.isfinite(depth), depth, 0.0).reshape(v.shape).astype(np.float32)


def label_street(log: FakeLog = LOG, shifts_m: tuple[float, ...] = (), recorded: bool = True) -> list[LabelledImage]:
    """Recorded images, then those of each shift."""
    chunk = chunk_of(log)
    labeller = LogLabeller(log)
    images = [labeller.label_recorded_image(chunk, view) for view in chunk.views] if recorded else []
    for view in place_novel_views(chunk, shifts_m, frames=chunk.frames):
        world_SE3_camera = chunk.world_SE3_chunk @ view.chunk_SE3_camera
        fake = world_SE3_camera.copy()
        fake[:3, 3] -= np.asarray(log.world_offset_m)
        image = log.render(fake, view.lens, view.frame)
        depth = true_depth(log, world_SE3_camera, view.lens, view.frame)
        images.append(labeller.label_view(chunk, view, image, shift_m=view.shift_m, rendered=True, depth=depth))
    return images


def distorted(images: list[LabelledImage], coefficients: tuple[float, ...]) -> list[LabelledImage]:
    """The same pixels, as if a distorting lens had taken them."""
    return [replace(image, lens=replace(image.lens, distortion=coefficients)) for image in images]
