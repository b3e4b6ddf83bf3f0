"""Logs with one fault: another log, some functions of which are replaced."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from genre_tasks.log_checks.lenses import find_implausible_lenses
from genre_tasks.log_checks.log_sample import LogSample
from genre_tasks.log_checks.plausibility import assess_plausibility
from genre_tasks.logs.findings import Finding
from genre_tasks.logs.types import Camera, DrivingLog, Float64, Lens
from tests.fakes import FakeCar, FakeLog

# Six cars around the path, so that boxes are judged as a group; one drives.
CARS = (
    FakeCar("mover", 6.0, 3.5, speed_mps=8.0),
    FakeCar("a", 9.0, -4.0),
    FakeCar("b", 15.0, 5.0),
    FakeCar("c", -6.0, -4.0),
    FakeCar("d", -12.0, 4.5),
    FakeCar("e", 16.0, -4.0),
)


def street(**changes: Any) -> FakeLog:
    """8 sound frames of a street, at 10 m/s."""
    log = FakeLog(frame_count=8, width_px=48, height_px=32, lidar_azimuths=360, cars=CARS, speed_mps=10.0)
    return log.with_(**changes)


class EditedLog:
    """A log whose attributes or functions are replaced, as a fault in its files would.

    Args:
        log: the sound log.
        changes: by name.
    """

    def __init__(self, log: DrivingLog, **changes: Any) -> None:
        self._log = log
        self.__dict__.update(changes)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._log, name)


def with_lens(log: DrivingLog, change: Callable[[Lens], Lens]) -> EditedLog:
    """The log with another lens for every camera."""
    return EditedLog(log, cameras=tuple(Camera(camera.name, change(camera.lens)) for camera in log.cameras))


def with_ego(log: DrivingLog, change: Callable[[int, Float64], Float64], *, rig: bool = True) -> EditedLog:
    """The log with other poses of the LiDAR, and of the cameras that are fixed to it where ``rig`` says so."""

    def world_SE3_lidar(frame: int) -> Float64:
        return change(frame, log.world_SE3_lidar(frame))

    def world_SE3_camera(camera: str, frame: int) -> Float64:
        mount = np.linalg.inv(log.world_SE3_lidar(frame)) @ log.world_SE3_camera(camera, frame)
        return world_SE3_lidar(frame) @ mount

    cameras = {"world_SE3_camera": world_SE3_camera} if rig else {}
    return EditedLog(log, world_SE3_lidar=world_SE3_lidar, **cameras)


def assess(log: Any) -> dict[str, Finding]:
    """What the plausibility checks find in all frames, by word."""
    found = assess_plausibility(log, tuple(range(log.frame_count)), log.cameras)
    return {finding.word: finding for finding in found}


def assess_lenses(log: Any) -> dict[str, Finding]:
    """What the check of lenses alone finds, by word: the images of a street do not fit other cameras' lenses."""
    sample = LogSample(log, tuple(range(log.frame_count)), log.cameras)
    return {finding.word: finding for finding in find_implausible_lenses(sample)}


def is_complete(finding: Finding) -> bool:
    """Whether a finding has what a user needs: numbers, and a remedy that is a sentence."""
    return bool(finding.numbers) and finding.remedy.endswith(".") and not finding.message.endswith(".")
