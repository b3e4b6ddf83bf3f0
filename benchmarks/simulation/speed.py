"""How fast rollouts render and encode, and whether their memory stays flat."""

from __future__ import annotations

import tempfile
import time
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import psutil
import torch

from benchmarks.common.bench import NotMeasuredError, Row
from benchmarks.common.claims import Claim, claim
from benchmarks.common.context import THREADS
from benchmarks.common.timing import Quartiles
from benchmarks.simulation.scenes import LogScenes, SimulationCase, cut_path, log_label, open_scenes
from flows.simulation.outputs import Films, open_outputs
from genre_tasks.ego_paths.behaviours import plan_behaviour
from genre_tasks.ego_paths.ego_path import EgoPath
from genre_tasks.render.types import RenderSettings
from genre_tasks.rollout.handover import plan_handovers
from genre_tasks.rollout.render_rollout import render_rollout
from genre_tasks.rollout.rig import RigCamera

CAMERAS = 3
SMALL_PX = (320, 180)
LARGE_PX = (1280, 720)
LEAST_SMALL = 20.0
LEAST_LARGE = 2.0
MOST_GROWTH = 0.05
LARGE_POSES = 8
MEMORY_POSES = 2000
_MEMORY_FROM = 200
_POSE_S = 0.1


def measure_speed(case: SimulationCase, rounds: int) -> Row:
    """Times rollouts of three cameras from the first render to the finished films, as ``genre simulate`` makes them.

    Args:
        case: the log.
        rounds: how often.

    Returns:
        Images a second, all cameras counted, by size; the larger images are of fewer poses.

    Raises:
        NotMeasuredError: the log has fewer cameras.
    """
    scenes = open_scenes(case)
    if len(scenes.rig) < CAMERAS:
        raise NotMeasuredError(f"the rig has {len(scenes.rig)} cameras, {CAMERAS} are timed")
    path = plan_behaviour("swerve", scenes.recorded, scenes.config.simulate, start_offset_m=0.0, strength=0.5)
    middle = max(0, (len(path) - LARGE_POSES) // 2)
    sizes = {"small": (SMALL_PX, path), "large": (LARGE_PX, cut_path(path, middle, LARGE_POSES))}
    seconds: dict[str, list[float]] = {name: [] for name in sizes}
    # The first round warms up: scenes are read and code is loaded.
    for k in range(rounds + 1):
        for name, (size_px, driven) in sizes.items():
            rig = [replace(camera, lens=camera.lens.resized(*size_px)) for camera in scenes.rig[:CAMERAS]]
            taken = _time_rollout(scenes, driven, rig)
            if k:
                seconds[name].append(taken)
    images = {name: CAMERAS * len(driven) for name, (_, driven) in sizes.items()}
    rates = {name: Quartiles.from_values([images[name] / s for s in seconds[name]]).as_row() for name in sizes}
    return {"log": case.log, "chunks": list(case.chunks), "cameras": CAMERAS, "images": images, "images_per_s": rates}


def _time_rollout(scenes: LogScenes, path: EgoPath, rig: Sequence[RigCamera]) -> float:
    handovers = plan_handovers(scenes.source, path, rig, scenes.config.simulate.handover_frames)
    torch.set_num_threads(THREADS)
    with tempfile.TemporaryDirectory() as folder:
        start = time.perf_counter()
        films = Films(Path(folder), rig, path.times_s, _POSE_S)
        with open_outputs([films]):
            settings = RenderSettings(threads=THREADS)
            for images in render_rollout(scenes.source, path, rig, settings, handovers):
                films.write(images)
        return time.perf_counter() - start


def measure_memory(case: SimulationCase, poses: int = MEMORY_POSES) -> Row:
    """Measures the process's memory along one long rollout of one camera.

    Args:
        case: the log.
        poses: how many, spread evenly over the recorded path.

    Returns:
        ``rss_mib`` by pose.
    """
    scenes = open_scenes(case)
    recorded = scenes.recorded
    rig = [replace(scenes.rig[0], lens=scenes.rig[0].lens.resized(*SMALL_PX))]
    path = _stretch(recorded, poses)
    handovers = plan_handovers(scenes.source, path, rig, scenes.config.simulate.handover_frames)
    first = min(_MEMORY_FROM, poses // 10)
    marks = sorted({first, *np.linspace(first, poses, 10).astype(int).tolist()})
    process = psutil.Process()
    rss = {}
    with tempfile.TemporaryDirectory() as folder:
        films = Films(Path(folder), rig, path.times_s, _POSE_S)
        with open_outputs([films]):
            for images in render_rollout(scenes.source, path, rig, handovers=handovers):
                films.write(images)
                if images.index + 1 in marks:
                    rss[str(images.index + 1)] = process.memory_info().rss / 2**20
    return {"log": case.log, "chunks": list(case.chunks), "poses": poses, "rss_mib": rss}


def _stretch(recorded: EgoPath, count: int) -> EgoPath:
    """The recorded path in small steps; poses between frames are those of the frame before."""
    moments = np.linspace(recorded.frames[0], recorded.frames[-1], count)
    rows = np.searchsorted(recorded.frames, moments, side="right") - 1
    times = np.interp(moments, recorded.frames, recorded.times_s)
    return EgoPath(times, moments, recorded.world_SE3_ego[rows])


def speed_claims(rows: Sequence[Row], memory: Sequence[Row]) -> Iterator[Claim]:
    """Claims that rollouts are fast enough, and that their memory does not grow.

    Args:
        rows: see :func:`measure_speed`.
        memory: see :func:`measure_memory`.
    """
    for name, least, size_px in (("small", LEAST_SMALL, SMALL_PX), ("large", LEAST_LARGE, LARGE_PX)):
        rates = [row["images_per_s"][name] for row in rows]
        # The slowest log's, since a user's log may be like it.
        slowest = min(rates, key=lambda rate: float(rate["median"]), default=None)
        note = f"{CAMERAS} cameras of {size_px[0]}×{size_px[1]}, rendered and encoded, {THREADS} threads; {_logs(rows)}"
        if slowest is None:
            yield claim(f"simulation.speed_{name}", None, ">=", least, "images/s", note)
        else:
            spread = (slowest["low"], slowest["high"])
            n = int(slowest["n"])
            yield claim(f"simulation.speed_{name}", slowest["median"], ">=", least, "images/s", note, n, spread)
    growth = [_measure_growth(row) for row in memory]
    note = f"resident memory at the last pose over that at an early one, less 1; {_logs(memory)}"
    yield claim("simulation.memory", max(growth, default=None), "<=", MOST_GROWTH, "part", note, len(growth))


def _measure_growth(row: Row) -> float:
    values = [row["rss_mib"][key] for key in sorted(row["rss_mib"], key=int)]
    return float(values[-1] / values[0] - 1)


def _logs(rows: Sequence[Row]) -> str:
    return ", ".join(log_label(row) for row in rows) or "no log"


def speed_table(rows: Sequence[Row], memory: Sequence[Row]) -> Iterator[str]:
    """Gives a line for each log and image size, and one for each long rollout.

    Args:
        rows: see :func:`measure_speed`.
        memory: see :func:`measure_memory`.
    """
    yield "| log | images | images a second, median | quartiles |"
    yield "|---|---|---|---|"
    for row in rows:
        for name, size_px in (("small", SMALL_PX), ("large", LARGE_PX)):
            rate = row["images_per_s"][name]
            size = f"{row['images'][name]} of {size_px[0]}×{size_px[1]}"
            yield f"| {log_label(row)} | {size} | {rate['median']:.1f} | {rate['low']:.1f}–{rate['high']:.1f} |"
    for row in memory:
        marks = ", ".join(f"{value:.0f} at pose {key}" for key, value in row["rss_mib"].items())
        yield f"\nResident memory along {row['poses']} poses of {log_label(row)}, MiB: {marks}."
