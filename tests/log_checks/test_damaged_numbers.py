"""Logs whose numbers are damaged at random: the checks find something or nothing, and never raise."""

from __future__ import annotations

import warnings
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from genre_tasks.logs.types import Camera, CuboidTrack, Lens
from tests.log_checks.edited_log import EditedLog, assess, street

VALUES = (float("nan"), float("inf"), float("-inf"), 0.0, 1e300, -1e300, 1e9, 1e-9, -1.0)
BASE = street(cars=street().cars[:5])


class Damage:
    """Replaces numbers by odd ones, reproducibly."""

    def __init__(self, seed: int) -> None:
        self.random = np.random.default_rng(seed)

    def chance(self) -> bool:
        return bool(self.random.random() < 0.4)

    def numbers(self, values: Any, fraction: float) -> np.ndarray:
        damaged = np.array(values, dtype=np.float64)
        hit = self.random.random(damaged.shape) < fraction
        damaged[hit] = self.random.choice(VALUES, hit.sum())
        return damaged

    def track(self, track: CuboidTrack) -> CuboidTrack:
        boxes = self.numbers(track.world_SE3_box, 0.02)
        length, width, height = self.numbers(track.size_m, 0.2)
        return replace(track, world_SE3_box=boxes, size_m=(float(length), float(width), float(height)))

    def lens(self, lens: Lens) -> Lens:
        focal_and_center = self.numbers((lens.fx_px, lens.fy_px, lens.cx_px, lens.cy_px), 0.3)
        coefficients = (-0.1, 0.01, 0.0, 0.0, 0.0, 0.0)[: self.random.integers(0, 7)]
        distortion = tuple(float(k) for k in self.numbers(coefficients, 0.3))
        return Lens(*(float(value) for value in focal_and_center), lens.width_px, lens.height_px, distortion)


@pytest.mark.parametrize("seed", range(40))
def test_no_check_raises_or_warns(seed: int) -> None:
    """Report: none found; the random damage that the list of odd logs asks for."""
    damage = Damage(seed)
    frames = range(BASE.frame_count)
    times = [BASE.frame_timestamp_s(frame) for frame in frames]
    changes: dict[str, Any] = {}
    if damage.chance():
        poses = [damage.numbers(BASE.world_SE3_lidar(frame), damage.random.choice([0.02, 0.2])) for frame in frames]
        changes["world_SE3_lidar"] = lambda frame: poses[frame]
    if damage.chance():
        mounts = [damage.numbers(BASE.world_SE3_camera("left", frame), 0.02) for frame in frames]
        changes["world_SE3_camera"] = lambda camera, frame: mounts[frame]
    if damage.chance():
        sweep_times = damage.numbers(times, 0.3)
        changes["frame_timestamp_s"] = lambda frame: float(sweep_times[frame])
    if damage.chance():
        camera_times = damage.numbers(times, 0.3)
        changes["camera_timestamp_s"] = lambda camera, frame: float(camera_times[frame])
    if damage.chance():
        tracks = tuple(damage.track(track) for track in BASE.tracks())
        changes["tracks"] = lambda: tracks
    if damage.chance():
        changes["cameras"] = tuple(Camera(camera.name, damage.lens(camera.lens)) for camera in BASE.cameras)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        found = assess(EditedLog(BASE, **changes))
    assert all(finding.message and finding.remedy for finding in found.values())
