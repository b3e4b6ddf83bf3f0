"""A made-up chunk for tests of viewers: a grey wall, and a red block that drives past it from left to right."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from flows.simulation.stored_ranges import SideRange
from flows.viewer.path_drawing import CameraImage, PathDrawing
from flows.viewer.scene_nodes import SceneNodes, SplatNode
from flows.viewer.viewed_chunks import ViewedChunk
from genre_tasks.exchange.types import NodeMotion
from genre_tasks.logs.types import Float64
from genre_tasks.progress import Progress, silent

FRAMES = tuple(range(10))
SIDES = SideRange(2.0, 1.5)
STEP_M = 0.8


def poses(x: Float64, y: Float64, z: float) -> Float64:
    """[F, 4, 4] without any turn."""
    out = np.tile(np.eye(4), (len(FRAMES), 1, 1))
    out[:, 0, 3] = x
    out[:, 1, 3] = y
    out[:, 2, 3] = z
    return out


def block(name: str, centers: Float64, rgb: tuple[float, float, float], motion: NodeMotion | None) -> SplatNode:
    count = len(centers)
    return SplatNode(
        name=name,
        centers=centers.astype(np.float32),
        covariances=np.tile(0.04 * np.eye(3, dtype=np.float32), (count, 1, 1)),
        rgbs=np.tile(np.array(rgb, np.float32), (count, 1)),
        opacities=np.full((count, 1), 0.95, np.float32),
        motion=motion,
    )


def grid(x: float, width_m: float, height_m: float) -> Float64:
    """Points of a wall across the way, [N, 3]."""
    y, z = np.meshgrid(np.arange(-width_m / 2, width_m / 2, 0.4), np.arange(0.0, height_m, 0.4))
    return np.stack([np.full(y.size, x), y.ravel(), z.ravel()], 1)


def make_viewed(number: int = 0, stage: str = "enet") -> ViewedChunk:
    """The chunk. The block is there at all frames but the last one, and a second one at the last one alone."""
    steps = np.arange(len(FRAMES), dtype=np.float64)
    there = np.arange(len(FRAMES)) < len(FRAMES) - 1
    motion = NodeMotion(poses(np.full(len(FRAMES), 12.0), 3.6 - STEP_M * steps, 0.0), there)
    nodes = (
        block("background", grid(16.0, 24.0, 6.0), (0.5, 0.5, 0.5), None),
        block("car-1", grid(0.0, 1.6, 1.6), (1.0, 0.0, 0.0), motion),
        block("bus-2", grid(0.0, 1.6, 1.6), (0.0, 0.0, 1.0), replace(motion, present=~there)),
    )
    ego = poses(0.5 * steps, 0.0 * steps, 1.5)
    return ViewedChunk(
        log="made-up <street>",
        number=number,
        stage=stage,
        frames=FRAMES,
        times_s=0.1 * steps,
        chunk_SE3_ego=ego,
        scene=SceneNodes(nodes, ("7 Gaussians are left out, those that fill least.",)),
        path=PathDrawing(ego[:, :3, 3] - [0.0, 0.0, 1.5], np.tile([0.0, 1.0, 0.0], (len(FRAMES), 1))),
        images=tuple(camera_image(frame, ego[frame]) for frame in FRAMES[::3]),
    )


def camera_image(frame: int, ego: Float64) -> CameraImage:
    """Of a camera that looks ahead."""
    ego_SE3_camera = np.eye(4)
    ego_SE3_camera[:3, :3] = [[0, 0, 1], [-1, 0, 0], [0, -1, 0]]
    pixels = np.full((9, 16, 3), 20 * frame, np.uint8)
    return CameraImage("front", frame, ego @ ego_SE3_camera, fov_rad=0.9, aspect=16 / 9, pixels=pixels)


class MadeUpRun:
    """What a viewer asks of a ``ViewedRun``, with two chunks and two stages."""

    name = "made-up"
    log = "synthetic:made-up"
    chunk_numbers = (0, 1)

    def __init__(self) -> None:
        self.asked: list[tuple[int, str]] = []

    def list_stages(self, number: int) -> tuple[str, ...]:
        return ("initial", "enet")

    def select(self, number: int | None, stage: str | None) -> tuple[int, str]:
        return number or 0, stage or "enet"

    def load(self, number: int, stage: str, progress: Progress = silent) -> ViewedChunk:
        self.asked.append((number, stage))
        return make_viewed(number, stage)

    def find_range(self, number: int, stage: str, progress: Progress = silent) -> SideRange:
        return SIDES
