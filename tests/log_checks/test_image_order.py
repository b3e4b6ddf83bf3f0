"""Images in another order than their poses: reversed, or early or late by a frame."""

from __future__ import annotations

from collections.abc import Callable
from functools import cached_property

import pytest

from genre_tasks.log_checks.calibration import find_miscalibration
from genre_tasks.log_checks.image_order import find_image_order
from genre_tasks.log_checks.log_sample import LogSample
from genre_tasks.logs.findings import Finding
from genre_tasks.logs.registry import open_log
from genre_tasks.logs.types import DrivingLog
from tests.log_checks.edited_log import EditedLog

CAMERA = "front_left_camera"


def open_street(size: str) -> DrivingLog:
    """A street whose images are drawn once, when they are asked for."""
    log = open_log(f"synthetic:street?{size}&cameras=2&samples=1&lidar_beams=32&lidar_azimuths=600")
    drawn: dict[tuple[str, int], bytes] = {}

    def image_bytes(camera: str, frame: int) -> bytes:
        if (camera, frame) not in drawn:
            drawn[camera, frame] = log.image_bytes(camera, frame)
        return drawn[camera, frame]

    return EditedLog(log, image_bytes=image_bytes)  # type: ignore[return-value]


class Streets:
    @cached_property
    def coarse(self) -> DrivingLog:
        return open_street("seed=7&frames=8&width=160&height=90")

    @cached_property
    def long(self) -> DrivingLog:
        return open_street("seed=4&frames=20&width=320&height=180")


@pytest.fixture(scope="module")
def streets() -> Streets:
    return Streets()


def reorder(log: DrivingLog, source: Callable[[int], int]) -> LogSample:
    """The log with the images of one camera in another order."""

    def image_bytes(camera: str, frame: int) -> bytes:
        return log.image_bytes(camera, source(frame) if camera == CAMERA else frame)

    edited = EditedLog(log, image_bytes=image_bytes)
    return LogSample(edited, tuple(range(log.frame_count)), log.cameras)  # type: ignore[arg-type]


def find(sample: LogSample) -> list[tuple[str, str | None]]:
    return [(found.word, found.camera) for found in find_miscalibration(sample)]


@pytest.mark.parametrize("street", ["coarse", pytest.param("long", marks=pytest.mark.slow)])
def test_the_order_of_a_sound_street_is_right(streets: Streets, street: str) -> None:
    sample = reorder(getattr(streets, street), lambda frame: frame)
    assert [find_image_order(sample, camera) for camera in sample.cameras] == [None, None]


@pytest.mark.parametrize("street", ["coarse", pytest.param("long", marks=pytest.mark.slow)])
def test_reversed_images_are_named(streets: Streets, street: str) -> None:
    """Report: pit30m/pit30m#67."""
    log = getattr(streets, street)
    assert find(reorder(log, lambda frame: log.frame_count - 1 - frame)) == [("images_out_of_order", CAMERA)]


@pytest.mark.parametrize("street", ["coarse", pytest.param("long", marks=pytest.mark.slow)])
@pytest.mark.parametrize("offset", [-1, 1])
def test_rotated_images_are_named(streets: Streets, street: str, offset: int) -> None:
    """Report: SBCV/Blender-Addon-Photogrammetry-Importer#58 (sorted by letters, so that numbers shift)."""
    log = getattr(streets, street)
    sample = reorder(log, lambda frame: (frame + offset) % log.frame_count)
    (finding,) = find_miscalibration(sample)
    assert isinstance(finding, Finding)
    assert (finding.word, finding.camera) == ("images_of_another_frame", CAMERA)
    assert finding.numbers["offset_frames"] == -offset
    # One of two checks names it, each with a margin of its own.
    assert finding.numbers["best_score"] >= finding.numbers["score"] + finding.numbers["min_margin"]


def test_a_vehicle_that_stands_gives_no_verdict(streets: Streets) -> None:
    """Images of one place have no order."""
    log = open_street("seed=7&frames=4&width=160&height=90&standstill=1")
    assert find(reorder(log, lambda frame: 3 - frame)) == []
