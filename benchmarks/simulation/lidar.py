"""Simulated LiDAR sweeps against real ones that no reconstruction has read."""

from __future__ import annotations

import time
from collections.abc import Sequence
from typing import Literal

import numpy as np

import benchmarks.simulation.heldout_sweeps as heldout_sweeps
from benchmarks.common.run_stages import print_progress, reconstruct
from benchmarks.common.task import require_log_folder
from flows.configuration import load_configuration
from flows.pipeline.stage_runner import Job, read_artifact
from genre_tasks.lidar_simulation.compare_sweeps import SweepComparison, compare_sweeps
from genre_tasks.lidar_simulation.lidar_surfaces import LidarSurfaces
from genre_tasks.lidar_simulation.rollout_lidar import LidarSimulator
from genre_tasks.lidar_simulation.simulate_sweep import simulate_sweep
from genre_tasks.logs.registry import open_log
from genre_tasks.logs.types import DrivingLog
from genre_tasks.scene_edits.chunk_scene import ChunkScene

Surfaces = Literal["points", "scene"]
"""What rays meet: discs on the chunk's LiDAR points, as rollouts do, or the Gaussians that images were fitted with."""

_STAGES = ("ingest", "effects", "initial", "gnet", "novel_views", "fnet", "enet")


def measure_lidar(
    log: str,
    chunk: int,
    store: str,
    *,
    every: int = 2,
    stage: str = "gnet",
    surfaces: Surfaces = "points",
    max_range_m: float = 40.0,
    settings: Sequence[str] = (),
) -> dict[str, object]:
    """Reconstructs a chunk without some of its sweeps, simulates these, and compares.

    The rays are those of the real sweep, also the ones that had no return; where the sensor is comes from a sweep that
    the reconstruction has read.

    Args:
        log: URI of the log.
        chunk: index of the chunk.
        store: folder of the store that stages come from and go to.
        every: frames that are multiples of it have their sweep; the others are held out.
        stage: of the scene: initial, gnet or enet. With ``points`` it decides on the actors alone.
        surfaces: what rays meet.
        max_range_m: returns farther off do not count.
        settings: ``section.key=value`` over the preset ``small``.

    Returns:
        A row: the protocol, the number of sweeps, the means of ``SweepComparison`` over them, the largest median
        range error of a sweep, and seconds a sweep.

    Raises:
        NotMeasuredError: the log's folder is missing.
        InputError: the chunk has no held-out sweep.
    """
    require_log_folder(log)
    config = load_configuration("small", settings=list(settings)).model_dump(mode="json")
    heldout_sweeps.register_reader()
    job = Job(f"{heldout_sweeps.READER}:{every}/{log}", chunk, store, config)
    refs = reconstruct(job, _STAGES[: _STAGES.index(stage) + 1])
    chunk_scene = ChunkScene(read_artifact(job, refs["ingest"]), read_artifact(job, refs[stage]).scene)
    full_log = open_log(log)
    frames = _find_heldout_frames(full_log, chunk_scene.chunk.frames, every)
    start = time.perf_counter()
    comparisons = _compare_frames(full_log, chunk_scene, frames, surfaces, max_range_m)
    seconds = (time.perf_counter() - start) / len(frames)
    row: dict[str, object] = {"log": full_log.name, "chunk": chunk, "every": every, "stage": stage}
    row |= {"surfaces": surfaces, "max_range_m": max_range_m, "sweeps": len(frames)}
    row |= {name: float(np.mean([vars(c)[name] for c in comparisons])) for name in vars(comparisons[0])}
    worst = max(comparison.median_range_error_m for comparison in comparisons)
    return row | {"worst_median_range_error_m": worst, "seconds_per_sweep": seconds}


def _find_heldout_frames(log: DrivingLog, frames: Sequence[int], every: int) -> list[int]:
    """Frames of a chunk whose sweep is held out, and is there."""
    return [frame for frame in frames if frame % every and log.sweep(frame) is not None]


def _compare_frames(
    full_log: DrivingLog,
    chunk_scene: ChunkScene,
    frames: Sequence[int],
    surfaces: Surfaces,
    max_range_m: float,
) -> list[SweepComparison]:
    # The first sweep, by which it finds the sensor, is one that was read: frame 0 is a multiple of any number.
    full = LidarSimulator(full_log)
    scene = LidarSurfaces().build(chunk_scene) if surfaces == "points" else chunk_scene.scene
    world_SE3_ego = np.stack([full_log.world_SE3_lidar(frame) for frame in range(full_log.frame_count)])
    poses = np.linalg.inv(chunk_scene.chunk.world_SE3_chunk) @ world_SE3_ego
    times_s = np.array([full_log.frame_timestamp_s(frame) for frame in range(full_log.frame_count)])
    comparisons = []
    for frame in frames:
        pattern = full.pattern_at(frame)
        sweep = simulate_sweep(scene, pattern, float(frame), poses, times_s - times_s[frame])
        comparisons.append(compare_sweeps(sweep, pattern.range_m, max_range_m))
        print_progress(f"frame {frame}: {comparisons[-1]}")
    return comparisons
