"""A made-up run of two chunks on a slope, small enough to be rendered often: its source, and views of it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from genre_tasks.config.simulation_sections import SimulateConfig
from genre_tasks.logs.types import Float64, Lens
from genre_tasks.render import RenderSettings, render_views
from genre_tasks.scene.actor_node import ActorNode
from genre_tasks.scene.chunk import Actor, Chunk, Points, View
from genre_tasks.scene.deformation import Deformation
from genre_tasks.scene.gaussians import Gaussians, map_attributes
from genre_tasks.scene.graph import FIRST_ACTOR, STATIC, SceneGraph
from genre_tasks.scene.transforms import compose_se3
from genre_tasks.scene_edits.actor_library import ActorLibrary
from genre_tasks.scene_edits.chunk_scene import ChunkScene, SceneSource
from genre_tasks.scene_edits.edited_scenes import EditedScenes
from genre_tasks.scene_edits.edits import EditList

SLOPE = 0.1
"""The ground rises by so many metres a metre along x, the direction of the drive."""

SIZE_M = (4.0, 2.0, 1.5)
LEFT_COLOR = (0.9, 0.1, 0.1)
RIGHT_COLOR = (0.1, 0.1, 0.9)
FRONT_COLOR = (0.1, 0.9, 0.1)
REAR_COLOR = (0.05, 0.05, 0.05)
LENS = Lens(fx_px=40.0, fy_px=40.0, cx_px=32.0, cy_px=18.0, width_px=64, height_px=36)
CAMERA_AXES = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
NO_SHADOW = SimulateConfig(contact_shadow=0.0)


def box_pose(x: float, y: float, yaw_deg: float = 0.0, clearance_m: float = 0.0) -> Float64:
    """A box on the slope in world coordinates, its bottom ``clearance_m`` above the ground."""
    tilt = Rotation.from_rotvec([0.0, -np.arctan(SLOPE), 0.0]).as_matrix()
    rotation = tilt @ Rotation.from_euler("z", yaw_deg, degrees=True).as_matrix()
    up = tilt[:, 2] * (SIZE_M[2] / 2 + clearance_m)
    return compose_se3(rotation, np.array([x, y, SLOPE * x]) + up)


class MadeRun:
    """A ``SceneSource`` of two chunks with 6 frames each.

    The car "a" drives at 1 m a frame in all frames, the parked car "b" stands, and the pedestrian "c" is in the second
    chunk alone. Cameras see both sides of "b", and the right side of "a" alone.
    """

    def __init__(self, road_srgb: float = 0.5, harmonics: bool = True, deforming: bool = False) -> None:
        self.chunk_numbers: Sequence[int] = (0, 1)
        self._scenes = [_make_chunk(number, road_srgb, harmonics, deforming) for number in (0, 1)]

    def load(self, number: int) -> ChunkScene:
        return self._scenes[number]


def _make_chunk(number: int, road_srgb: float, harmonics: bool, deforming: bool) -> ChunkScene:
    frames = tuple(range(6 * number, 6 * number + 6))
    offset = np.array([6.0 * number, 0.0, 0.0])
    world_SE3_chunk = compose_se3(np.eye(3), offset)
    # A LiDAR 2 m above the road, which drives 1 m a frame.
    ego = np.stack([compose_se3(np.eye(3), [float(f), 0.0, SLOPE * f + 2.0] - offset) for f in frames])
    tracks = {
        "a": ("Car", frames, [box_pose(8.0 + f, 3.0) for f in frames]),
        "b": ("Car", frames, [box_pose(15.0, -4.0)] * 6),
    }
    if number == 1:
        tracks["c"] = ("Pedestrian", frames[2:], [box_pose(20.0, 6.0, 90.0)] * 4)
    nodes = tuple(
        ActorNode(name, label, SIZE_M, np.array(at, np.int64), np.stack(poses) - _translation(offset))
        for name, (label, at, poses) in tracks.items()
    )
    grid = np.stack(np.meshgrid(np.arange(-10.0, 40.0, 0.5), np.arange(-9.0, 9.0, 0.5)), -1).reshape(-1, 2)
    ground = np.concatenate([grid, SLOPE * grid[:, :1]], 1) - offset
    static = _discs(ground, (road_srgb,) * 3, 0.35)
    parts = [static, *(_colored_box() for _ in nodes)]
    labels = [STATIC, *(FIRST_ACTOR + k for k in range(len(nodes)))]
    gaussians = map_attributes(lambda *x: torch.cat(x), *parts)
    counts = [torch.full((len(part),), label) for part, label in zip(parts, labels, strict=True)]
    scene = SceneGraph(gaussians, torch.cat(counts), nodes)
    if harmonics:
        generator = torch.Generator().manual_seed(number)
        values = 0.02 * torch.randn(len(scene), 8, 3, generator=generator)
        scene = scene.with_spherical_harmonics(values)
    if deforming:
        zero = Deformation.zero(nodes, (0,), frames)
        scene = replace(scene, deformation=zero.with_offsets(zero.offsets + torch.arange(6.0)[:, None, None] / 10))
    points = Points(
        ground.astype(np.float32),
        np.full((len(ground), 3), 128, np.uint8),
        np.ones(len(ground), bool),
        np.zeros(len(ground), np.int16),
    )
    empty = Points(np.zeros((0, 3), np.float32), np.zeros((0, 3), np.uint8), np.zeros(0, bool), np.zeros(0, np.int16))
    chunk = Chunk(
        dataset="made",
        log="up",
        index=number,
        frames=frames,
        camera_names=("front", "right"),
        width_px=LENS.width_px,
        height_px=LENS.height_px,
        world_SE3_chunk=world_SE3_chunk,
        chunk_SE3_ego=ego,
        views=tuple(
            View(camera, f, "source", 0.1 * f, pose @ compose_se3(CAMERA_AXES, np.array([0.0, left, 0.0])), LENS, b"")
            for camera, left in (("front", 0.0), ("right", -9.0))
            for f, pose in zip(frames, ego, strict=True)
        ),
        static=points,
        actors=tuple(Actor(n.track_id, n.label, n.size_m, n.frames, n.chunk_SE3_box, empty) for n in nodes),
        log_issues=(),
    )
    return ChunkScene(chunk, scene)


def _translation(offset: Float64) -> Float64:
    out = np.zeros((4, 4))
    out[:3, 3] = offset
    return out


def _discs(points: Float64, color: tuple[float, float, float], size_m: float) -> Gaussians:
    n = len(points)
    return Gaussians(
        torch.from_numpy(points).float(),
        torch.tensor([size_m, size_m, 0.02]).log().expand(n, 3).clone(),
        torch.tensor([1.0, 0.0, 0.0, 0.0]).expand(n, 4).clone(),
        torch.full((n,), 4.0),
        torch.tensor(color).expand(n, 3).clone(),
    )


def _colored_box() -> Gaussians:
    # Balls on all sides, each side in its colour.
    along = np.stack(np.meshgrid(np.linspace(-1.7, 1.7, 8), np.linspace(-0.5, 0.5, 4)), -1).reshape(-1, 2)
    across = np.stack(np.meshgrid(np.linspace(-0.8, 0.8, 5), np.linspace(-0.5, 0.5, 4)), -1).reshape(-1, 2)
    left = _balls(np.stack([along[:, 0], np.full(len(along), 0.9), along[:, 1]], 1), LEFT_COLOR)
    right = _balls(np.stack([along[:, 0], np.full(len(along), -0.9), along[:, 1]], 1), RIGHT_COLOR)
    front = _balls(np.stack([np.full(len(across), 1.9), across[:, 0], across[:, 1]], 1), FRONT_COLOR)
    rear = _balls(np.stack([np.full(len(across), -1.9), across[:, 0], across[:, 1]], 1), REAR_COLOR)
    top = np.stack(np.meshgrid(np.linspace(-1.7, 1.7, 8), np.linspace(-0.8, 0.8, 5)), -1).reshape(-1, 2)
    roof = _balls(np.concatenate([top, np.full((len(top), 1), 0.6)], 1), REAR_COLOR)
    return map_attributes(lambda *x: torch.cat(x), left, right, front, rear, roof)


def _balls(points: Float64, color: tuple[float, float, float]) -> Gaussians:
    discs = _discs(points, color, 0.15)
    return replace(discs, log_scales=torch.full_like(discs.log_scales, float(np.log(0.2))))


def edit(source: SceneSource, *edits: object, config: SimulateConfig = NO_SHADOW, **runs: SceneSource) -> EditedScenes:
    """Edits a run; other runs by their names."""
    return EditedScenes(source, EditList(edits=edits), ActorLibrary(lambda name: runs[name]), config)  # type: ignore[arg-type]


def draw(chunk_scene: ChunkScene, frame: int | None = None, pose: Float64 | None = None) -> torch.Tensor:
    """Colours [36, 64, 3] of the camera at a frame, or at another pose."""
    view = chunk_scene.chunk.views[0 if frame is None else chunk_scene.chunk.frames.index(frame)]
    if pose is not None:
        view = replace(view, chunk_SE3_camera=pose)
    with torch.no_grad():
        return render_views(chunk_scene.scene, [view], RenderSettings(threads=1)).color[0]


def draw_actor(chunk_scene: ChunkScene, track_id: str, pose: Float64 | None = None) -> torch.Tensor:
    """Colours [36, 64, 3] of one actor in front of nothing."""
    scene = chunk_scene.scene
    number = [node.track_id for node in scene.actors].index(track_id)
    rows = torch.nonzero(scene.nodes == FIRST_ACTOR + number)[:, 0]
    harmonics = scene.spherical_harmonics
    alone = replace(
        scene,
        gaussians=map_attributes(lambda x: x[rows], scene.gaussians),
        nodes=scene.nodes[rows],
        spherical_harmonics=None if harmonics is None else harmonics[rows],
    )
    return draw(replace(chunk_scene, scene=alone), pose=pose)


def find_node(chunk_scene: ChunkScene, track_id: str) -> ActorNode:
    """An actor of a scene."""
    return next(node for node in chunk_scene.scene.actors if node.track_id == track_id)


def world_poses(chunk_scene: ChunkScene, track_id: str) -> Float64:
    """The poses [F, 4, 4] of an actor in world coordinates."""
    return chunk_scene.chunk.world_SE3_chunk @ find_node(chunk_scene, track_id).chunk_SE3_box


def ground_distance(pose: Float64) -> float:
    """How far the middle of a box's bottom is above the slope, metres."""
    bottom = pose[:3, 3] - pose[:3, 2] * SIZE_M[2] / 2
    return float(bottom[2] - SLOPE * bottom[0])
