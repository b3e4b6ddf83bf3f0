"""Hard cases 4 and 22–26: far world origins, timestamps, turns, tracks that end, unfit cuboids, actors put anywhere."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from genre_tasks.config import IngestConfig
from genre_tasks.logs.types import CuboidTrack, Lens
from genre_tasks.render import Cameras, RenderSettings, render
from genre_tasks.scene.actor_node import ActorNode
from genre_tasks.scene.chunk import NO_SWEEP, Chunk
from genre_tasks.scene.gaussians import Gaussians
from genre_tasks.scene.graph import FIRST_ACTOR, SceneGraph
from genre_tasks.scene.rotations import quats_to_matrices_numpy
from genre_tasks.scene.transforms import interpolate_pose, is_rigid_transform
from genre_tasks.stages.ingest import ingest
from tests.fakes import FakeCar, FakeLog, camera_turn, yaw_pose

CONFIG = IngestConfig(width_px=96, height_px=64)


@pytest.fixture(scope="module")
def log() -> FakeLog:
    return FakeLog()


@pytest.fixture(scope="module")
def chunk(log: FakeLog) -> Chunk:
    return ingest(CONFIG, log, 0)


def _kinds(chunk: Chunk) -> list[str]:
    return [m.kind for m in chunk.log_issues]


@pytest.mark.parametrize("offset", [(1e6, -1e6, 0.0), (4.4e5, 4.6e6, 100.0)])
def test_a_far_world_origin_changes_nothing(log: FakeLog, chunk: Chunk, offset: tuple[float, float, float]) -> None:
    far = ingest(CONFIG, log.with_(world_offset_m=offset), 0)
    lidar, far_lidar = (c.static.positions[c.static.frames != NO_SWEEP] for c in (chunk, far))
    assert lidar.shape == far_lidar.shape and np.abs(lidar - far_lidar).max() < 1e-3
    assert np.abs(far.chunk_SE3_ego - chunk.chunk_SE3_ego).max() < 1e-6
    assert np.abs(far.actors[0].chunk_SE3_box - chunk.actors[0].chunk_SE3_box).max() < 1e-6
    assert np.abs(far.views[7].chunk_SE3_camera - chunk.views[7].chunk_SE3_camera).max() < 1e-6


def test_standstill_and_odd_timestamps(log: FakeLog) -> None:
    times = tuple(1.7e9 + 0.1 * f for f in range(20))
    odd = (*times[:5], times[4], times[9], times[6], *times[8:])
    out = ingest(CONFIG, log.with_(speed_mps=0.0, timestamps_s=odd), 0)
    assert _kinds(out) == ["timestamps", "standstill"]
    assert len(out.actors) == 1 and np.isfinite(out.static.positions).all()
    assert _kinds(ingest(CONFIG, log.with_(timestamps_s=times), 0)) == []


def _track(name: str, frames: list[int], poses: list[np.ndarray], **changes: object) -> CuboidTrack:
    track = CuboidTrack(name, "car", np.array(frames), np.stack(poses), (4.0, 1.8, 1.5), True)
    return replace(track, **changes)  # type: ignore[arg-type]


def test_cuboids_that_are_unfit(log: FakeLog) -> None:
    here = yaw_pose(0.0, (20.0, 0.0, 0.75))
    there = yaw_pose(0.0, (26.0, 0.0, 0.75))
    nan = here.copy()
    nan[0, 3] = np.nan
    tracks = (
        _track("after", [30, 31], [here, there]),
        _track("before", [-3, -2], [here, there]),
        _track("nan", [0, 1, 2], [nan, nan, nan]),
        _track("flat", [0, 19], [here, there], size_m=(4.0, float("nan"), 1.5)),
        _track("brief", [7], [here]),
        _track("empty", [0, 19], [yaw_pose(0.0, (0.0, 60.0, 30.0)), yaw_pose(0.0, (9.0, 60.0, 30.0))]),
    )
    out = ingest(CONFIG, log.with_(extra_tracks=tracks), 0)
    assert [a.track_id for a in out.actors] == ["mover"]
    assert sorted(_kinds(out)) == ["actor_few_points"] * 2 + ["cuboid_invalid"] * 2 + ["cuboid_outside"]
    (outside,) = [m for m in out.log_issues if m.kind == "cuboid_outside"]
    assert outside.detail.startswith("2 tracks")


def test_poses_between_annotations_and_past_the_end() -> None:
    sparse = FakeLog(cars=(FakeCar("mover", 6.0, 3.5, speed_mps=6.0),), track_every=6)
    (actor,) = ingest(CONFIG, sparse, 0).actors
    assert actor.frames.tolist() == list(range(19)), "annotated at 0, 6, 12, 18: nothing is extrapolated to 19"
    expected = 6.0 + 0.6 * np.arange(19) - 3.0
    assert np.allclose(actor.chunk_SE3_box[:, 0, 3], expected)


@pytest.mark.parametrize("yaw", [0.0, 1e-12, 0.5, np.pi - 1e-9, np.pi, -np.pi, 3.5])
def test_interpolation_is_the_shortest_turn(yaw: float) -> None:
    start, end = yaw_pose(0.3, (0.0, 0.0, 0.0)), yaw_pose(0.3 + yaw, (2.0, 4.0, 0.0))
    assert np.allclose(interpolate_pose(start, end, 0.0), start, atol=1e-9)
    assert np.allclose(interpolate_pose(start, end, 1.0), end, atol=1e-9)
    middle = interpolate_pose(start, end, 0.5)
    assert is_rigid_transform(middle, 1e-9) and np.allclose(middle[:3, 3], [1, 2, 0])
    angle = np.arccos(np.clip((np.trace(start[:3, :3].T @ middle[:3, :3]) - 1) / 2, -1, 1))
    shortest = abs((yaw + np.pi) % (2 * np.pi) - np.pi)
    assert angle == pytest.approx(shortest / 2, abs=1e-6)


def _one_actor_graph(yaw: float) -> SceneGraph:
    gaussians = Gaussians(
        torch.tensor([[1.0, 0.0, 0.0], [1.0, 0.0, 0.0]]),
        torch.zeros(2, 3),
        torch.tensor([[1.0, 0, 0, 0]] * 2),
        torch.zeros(2),
        torch.zeros(2, 3),
    )
    actor = ActorNode("a", "car", (4.0, 2.0, 1.5), np.array([3]), yaw_pose(yaw, (10.0, 0.0, 0.0))[None])
    return SceneGraph(gaussians, torch.tensor([0, FIRST_ACTOR]), (actor,))


@pytest.mark.parametrize("yaw", [0.0, 0.4, np.pi, -np.pi])
def test_actor_at_any_yaw_also_a_half_turn(yaw: float) -> None:
    posed = _one_actor_graph(yaw).gaussians_at(3)
    assert torch.allclose(posed.means[0], torch.tensor([1.0, 0, 0]))
    assert np.allclose(posed.means[1].numpy(), [10 + np.cos(yaw), np.sin(yaw), 0], atol=1e-6)
    assert np.allclose(
        quats_to_matrices_numpy(posed.quats[1].double().numpy()), yaw_pose(yaw, (0, 0, 0))[:3, :3], atol=1e-6
    )


def test_a_gap_in_a_track_says_nothing_of_the_motion() -> None:
    frames = np.array([0, 1, 2, 16, 17, 30])
    poses = np.stack([np.eye(4)] * 6)
    poses[:, 0, 3] = frames
    # Beyond the gap the car is 40 m to the side, as another car with its name would be.
    poses[3:, 1, 3] = 40.0
    car = ActorNode("a", "car", (4.0, 2.0, 1.5), frames, poses)
    for frame in (0, 1, 2, 16, 17):
        assert car.motion(frame)[0].tolist() == [1.0, 0.0, 0.0]
    assert not car.motion(30)[0].any()


def test_actor_absent_past_its_track() -> None:
    posed = _one_actor_graph(0.0).gaussians_at(4)
    assert float(torch.sigmoid(posed.logit_opacities[1])) < 1 / 255 and float(posed.logit_opacities[0]) == 0.0


@pytest.mark.parametrize("backend", ["cpu", "reference"])
def test_an_actor_inside_the_background_renders_finite(backend: str) -> None:
    graph = _one_actor_graph(np.pi)
    packed = graph.gaussians.pack().clone()
    packed[0, :3] = torch.tensor([9.0, 0.0, 0.0])  # where the actor's Gaussian comes to lie
    pose = np.eye(4)
    pose[:3, :3] = camera_turn(0.0)
    cameras = Cameras.from_poses([pose], [Lens(20.0, 20.0, 16.0, 12.0, 32, 24)])
    splats = graph.with_gaussians(Gaussians.unpack(packed)).gaussians_at(3).activate()
    image = render(splats, cameras, RenderSettings(backend=backend))
    assert torch.allclose(splats.means[0], splats.means[1], atol=1e-5)
    assert image.color.isfinite().all() and 0.7 < float(image.alpha.max()) <= 1.0


def test_microseconds_survive(log: FakeLog) -> None:
    times = tuple(1.7e9 + 1e-6 * f for f in range(20))
    out = ingest(CONFIG, log.with_(timestamps_s=times), 0)
    assert "timestamps" not in _kinds(out)
    stamps = np.array([v.timestamp_s for v in out.views[::2]])
    assert np.allclose(np.diff(stamps), 1e-6, atol=3e-7)
