"""A chunk of the fake street whose one car drives ahead, and what removing it leaves; small enough for seconds."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cache

import numpy as np
import torch

from genre_tasks.config import IngestConfig, InitialConfig
from genre_tasks.ego_paths.ego_path import EgoPath
from genre_tasks.ego_paths.recorded_path import join_recorded_path
from genre_tasks.rollout.render_rollout import RolloutImages, render_rollout
from genre_tasks.rollout.rig import estimate_rig
from genre_tasks.scene.gaussians import map_attributes
from genre_tasks.scene.graph import FIRST_ACTOR
from genre_tasks.scene_edits.chunk_scene import ChunkScene
from genre_tasks.stages.ingest import ingest
from genre_tasks.stages.initial import initial
from tests.fakes import FakeCar, FakeLog

CAR = FakeCar("mover", 7.0, 0.0, speed_mps=6.0)


@dataclass(frozen=True)
class OneChunk:
    """A scene source of one chunk."""

    chunk_scene: ChunkScene

    @property
    def chunk_numbers(self) -> tuple[int, ...]:
        return (0,)

    def load(self, number: int) -> ChunkScene:
        assert number == 0
        return self.chunk_scene


@dataclass(frozen=True)
class TwoChunks:
    """A scene source of two chunks."""

    chunk_scenes: tuple[ChunkScene, ...]
    chunk_numbers: tuple[int, ...] = (0, 1)

    def load(self, number: int) -> ChunkScene:
        return self.chunk_scenes[number]


def reconstruct(frame_count: int, chunk_count: int) -> tuple[ChunkScene, ...]:
    """The street as recorded, in chunks of 8 frames."""
    log = FakeLog(frame_count=frame_count, cars=(CAR,), camera_names=("front",))
    chunks = [ingest(IngestConfig(width_px=64, height_px=40, chunk_frames=8), log, k) for k in range(chunk_count)]
    scenes = [initial(InitialConfig(max_points=3000, distant_count=200), chunk).scene for chunk in chunks]
    assert all([actor.track_id for actor in scene.actors] == ["mover"] for scene in scenes)
    return tuple(ChunkScene(chunk, scene) for chunk, scene in zip(chunks, scenes, strict=True))


@cache
def recorded() -> OneChunk:
    """The street as recorded."""
    return OneChunk(*reconstruct(frame_count=8, chunk_count=1))


@cache
def two_chunks() -> TwoChunks:
    """The street as recorded, for twice as long."""
    return TwoChunks(reconstruct(frame_count=16, chunk_count=2))


@cache
def without_car() -> OneChunk:
    """The street without its car."""
    return OneChunk(remove_car(recorded().chunk_scene))


def remove_car(base: ChunkScene) -> ChunkScene:
    """The chunk without its car."""
    stays = base.scene.nodes < FIRST_ACTOR
    scene = replace(
        base.scene,
        gaussians=map_attributes(lambda values: values[stays], base.scene.gaussians),
        nodes=base.scene.nodes[stays],
        actors=(),
    )
    return ChunkScene(replace(base.chunk, actors=()), scene, base.scene.actors)


def path_at(*frames: float) -> EgoPath:
    """The recorded path at some frames, or moments between them."""
    path = join_recorded_path([recorded().chunk_scene.chunk])
    poses = [path.world_SE3_ego[int(np.floor(f))] for f in frames]
    return EgoPath(0.1 * np.asarray(frames), np.asarray(frames, np.float64), np.stack(poses))


def images_at(source: OneChunk, *frames: float) -> list[RolloutImages]:
    """The rollout's images at some moments."""
    rig = estimate_rig([recorded().chunk_scene.chunk])
    return list(render_rollout(source, path_at(*frames), rig))


def covered_by_car(frame: float) -> torch.Tensor:
    """[1, H, W] where removing the car changes the render visibly."""
    before = images_at(recorded(), frame)[0].color
    after = images_at(without_car(), frame)[0].color
    return (before - after).abs().amax(-1) > 2 / 255
