"""Sweeps simulated from the points of other sweeps, against true ranges."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import pytest
import torch

from genre_tasks.ego_paths.ego_path import EgoPath
from genre_tasks.errors import InputError
from genre_tasks.lidar_simulation.compare_sweeps import compare_sweeps
from genre_tasks.lidar_simulation.lidar_surfaces import LidarSurfaces
from genre_tasks.lidar_simulation.rollout_lidar import LidarSimulator
from genre_tasks.lidar_simulation.simulate_sweep import LidarModel, SimulatedSweep, simulate_sweep
from genre_tasks.lidar_simulation.sweep_pattern import build_pattern
from genre_tasks.logs.types import Sweep
from genre_tasks.scene.actor_node import ActorNode
from genre_tasks.scene.gaussians import Gaussians
from genre_tasks.scene.graph import DISTANT, SceneGraph
from genre_tasks.scene_edits.chunk_scene import ChunkScene
from tests.lidar_simulation.spinning_lidar import POSITION_M, beams, build_chunk, cast_street, ego_path, scan
from tests.lidar_simulation.test_sensor import true_sensor

EMPTY = SceneGraph(Gaussians.unpack(torch.zeros(0, 14)), torch.zeros(0, dtype=torch.int64), ())


@dataclass(frozen=True)
class SpinningLog:
    """A log of sweeps alone; those of some frames are missing."""

    missing: tuple[int, ...] = ()
    uri: str = "test:street"
    frame_count: int = 5

    def sweep(self, frame: int) -> Sweep | None:
        return None if frame in self.missing else scan(frame)

    def frame_timestamp_s(self, frame: int) -> float:
        return float(ego_path()[0][frame])

    def world_SE3_lidar(self, frame: int) -> np.ndarray:
        return ego_path()[1][frame]


class DamagedLog(SpinningLog):
    """Frame 0 has no pose that can be read, and frame 1 no sweep."""

    def sweep(self, frame: int) -> Sweep | None:
        if frame == 1:
            raise InputError("the file is cut off", remedy="Copy it.", frame=frame)
        return super().sweep(frame)

    def world_SE3_lidar(self, frame: int) -> np.ndarray:
        if frame == 0:
            raise InputError("the pose is not finite", remedy="Correct it.", frame=frame)
        return super().world_SE3_lidar(frame)


@pytest.fixture(scope="module")
def chunk_scene() -> ChunkScene:
    return ChunkScene(build_chunk((0, 2, 4)), EMPTY)


@pytest.fixture(scope="module")
def surfaces(chunk_scene: ChunkScene) -> SceneGraph:
    return LidarSurfaces(20_000).build(chunk_scene)


def simulate(surfaces: SceneGraph, frame: int = 1, model: LidarModel | None = None, shift_m: float = 0.0):
    times, poses = ego_path()
    poses = poses.copy()
    poses[:, 1, 3] += shift_m
    directions, offsets, _ = beams()
    pattern = build_pattern(POSITION_M + directions * 10, offsets, np.full(len(offsets), 0.5), true_sensor())
    return simulate_sweep(surfaces, pattern, frame, poses, times - times[frame], model)


def test_a_sweep_that_was_not_read_comes_out_right(surfaces: SceneGraph):
    sweep = simulate(surfaces)
    comparison = compare_sweeps(sweep, cast_street(sweep.origins, sweep.directions), 30.0)
    assert comparison.median_range_error_m < 0.02
    assert comparison.recall > 0.95
    assert comparison.precision > 0.95
    assert comparison.chamfer_m < 0.2


def test_a_sweep_from_another_lane_comes_out_right(surfaces: SceneGraph):
    sweep = simulate(surfaces, shift_m=3.0)
    assert np.abs(sweep.origins[:, 1] - 3.0 - POSITION_M[1]).max() < 1e-9
    comparison = compare_sweeps(sweep, cast_street(sweep.origins, sweep.directions), 30.0)
    assert comparison.median_range_error_m < 0.03
    assert comparison.recall > 0.9


def test_the_vehicle_moves_while_the_sensor_turns(surfaces: SceneGraph):
    sweep = simulate(surfaces)
    assert np.ptp(sweep.origins[:, 0]) == pytest.approx(1.0, abs=0.02)


def test_what_is_too_far_or_distant_does_not_come_back(surfaces: SceneGraph):
    near = simulate(surfaces, model=LidarModel(max_range_m=9.0))
    assert np.nanmax(near.range_m) <= 9.0
    assert np.isnan(near.intensity[np.isnan(near.range_m)]).all()
    distant = replace(surfaces, nodes=torch.full_like(surfaces.nodes, DISTANT))
    assert np.isnan(simulate(distant).range_m).all()


def test_the_same_points_are_fitted_once(chunk_scene: ChunkScene):
    builder = LidarSurfaces(2000)
    first = builder.build(chunk_scene)
    again = builder.build(ChunkScene(replace(chunk_scene.chunk), EMPTY))
    assert torch.equal(first.gaussians.means, again.gaussians.means)
    assert len(builder._fitted) == 1


def test_chunk_and_scene_need_the_same_actors(chunk_scene: ChunkScene):
    actor = ActorNode("7", "car", (4.0, 2.0, 1.5), np.array([0]), np.eye(4)[None])
    with pytest.raises(ValueError, match="got 0 and 1"):
        LidarSurfaces().build(replace(chunk_scene, scene=replace(EMPTY, actors=(actor,))))


def test_a_rollout_takes_the_rays_of_the_nearest_sweep(chunk_scene: ChunkScene):
    times, poses = ego_path()
    path = EgoPath(times, np.arange(5.0), poses)
    simulator = LidarSimulator(SpinningLog(missing=(0, 1)))
    assert simulator.pattern_at(0.0) is simulator.pattern_at(2.2)
    sweep = simulator.simulate(path, 1, chunk_scene)
    comparison = compare_sweeps(sweep, cast_street(sweep.origins, sweep.directions), 30.0)
    assert comparison.median_range_error_m < 0.02
    assert comparison.recall > 0.95


def test_sweeps_and_poses_that_cannot_be_read_are_passed_over(chunk_scene: ChunkScene):
    times, poses = ego_path()
    simulator = LidarSimulator(DamagedLog())
    assert simulator.pattern_at(0.0) is simulator.pattern_at(2.2)
    sweep = simulator.simulate(EgoPath(times, np.arange(5.0), poses), 1, chunk_scene)
    comparison = compare_sweeps(sweep, cast_street(sweep.origins, sweep.directions), 30.0)
    assert comparison.median_range_error_m < 0.02


def test_a_log_without_sweeps_is_one_clear_error():
    simulator = LidarSimulator(SpinningLog(missing=tuple(range(5))))
    with pytest.raises(InputError, match="no LiDAR sweep"):
        simulator.pattern_at(0.0)


def sweep_of(range_m: list[float]) -> SimulatedSweep:
    count = len(range_m)
    return SimulatedSweep(
        frame=0.0,
        origins=np.zeros((count, 3)),
        directions=np.eye(3)[np.arange(count) % 3],
        range_m=np.array(range_m),
        intensity=np.ones(count),
        times_s=np.zeros(count),
        ring=np.zeros(count, np.int64),
        node=np.zeros(count, np.int64),
    )


def test_the_comparison_counts_as_it_says():
    nan = np.nan
    comparison = compare_sweeps(sweep_of([10.0, 20.4, nan, 5.0, 60.0]), np.array([10.1, 22.0, 8.0, nan, 39.0]), 40.0)
    assert comparison.rays == 4
    assert comparison.median_range_error_m == pytest.approx(1.6)
    assert comparison.hit_recall == 0.75
    assert comparison.recall == 0.25
    assert comparison.hit_precision == pytest.approx(2 / 3)
    assert comparison.precision == pytest.approx(1 / 3)


def test_a_comparison_of_nothing_is_not_a_number():
    comparison = compare_sweeps(sweep_of([np.nan]), np.array([np.nan]))
    assert comparison.rays == 0
    assert np.isnan(comparison.recall) and np.isnan(comparison.chamfer_m) and np.isnan(comparison.median_range_error_m)
