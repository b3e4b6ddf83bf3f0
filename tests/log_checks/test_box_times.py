"""Boxes under other frames than the sweeps that they were drawn on."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from genre_tasks.log_checks.box_times import find_boxes_of_another_frame
from genre_tasks.log_checks.log_sample import LogSample
from genre_tasks.logs.findings import Finding
from genre_tasks.logs.registry import open_log
from genre_tasks.logs.types import CuboidTrack, DrivingLog
from tests.log_checks.edited_log import EditedLog, assess, is_complete

SMALL = "frames=8&cameras=1&width=32&height=18&samples=1&lidar_beams=32&lidar_azimuths=300"


def find(log: DrivingLog) -> list[Finding]:
    return list(find_boxes_of_another_frame(LogSample(log, tuple(range(log.frame_count)), log.cameras)))


def reorder(log: DrivingLog, change: Callable[[int], int]) -> EditedLog:
    """The log with the boxes of every frame under another frame."""

    def move(track: CuboidTrack) -> CuboidTrack:
        frames = np.array([change(int(frame)) for frame in track.frames])
        order = np.argsort(frames)
        return replace(track, frames=frames[order], world_SE3_box=track.world_SE3_box[order])

    return EditedLog(log, tracks=lambda: tuple(move(track) for track in log.tracks()))


@pytest.mark.parametrize(
    ("change", "offset"),
    [
        (lambda frame: frame + 1, 1.0),
        (lambda frame: frame - 1, -1.0),
        (lambda frame: (frame + 1) % 8, 1.0),
        (lambda frame: (frame - 1) % 8, -1.0),
        (lambda frame: frame + 2, 2.0),
        (lambda frame: frame - 2, -2.0),
        (lambda frame: 7 - frame, None),
    ],
    ids=["late", "early", "rotated late", "rotated early", "two late", "two early", "reversed"],
)
@pytest.mark.parametrize("seed", [6, 7])
def test_boxes_under_other_frames(seed: int, change: Callable[[int], int], offset: float | None) -> None:
    """Report: ucla-mobility/OpenCDA#207 (a delay between LiDAR and annotated boxes)."""
    (finding,) = find(reorder(open_log(f"synthetic:street?seed={seed}&{SMALL}"), change))
    assert finding.word == "boxes_of_another_frame"
    assert finding.numbers.get("offset") == offset
    assert finding.numbers["points_with_offset"] > finding.numbers["points_inside"]
    assert is_complete(finding)


def test_the_check_of_a_log_names_rotated_boxes() -> None:
    """Report: ucla-mobility/OpenCDA#207."""
    found = assess(reorder(open_log(f"synthetic:street?seed=7&{SMALL}"), lambda frame: (frame - 1) % 8))
    assert "boxes_of_another_frame" in found


def test_sound_boxes_and_boxes_that_stand() -> None:
    log = open_log(f"synthetic:street?seed=7&{SMALL}")
    assert find(log) == []
    still = [track for track in log.tracks() if np.ptp(track.world_SE3_box[:, :3, 3], axis=0).max() < 0.1]
    assert still
    standing = EditedLog(log, tracks=lambda: tuple(still))
    assert find(reorder(standing, lambda frame: (frame + 1) % 8)) == []


def test_sweeps_and_boxes_that_are_not_there() -> None:
    log = open_log(f"synthetic:street?seed=7&{SMALL}")
    assert find(EditedLog(log, tracks=lambda: ())) == []
    without_lidar = open_log(f"synthetic:street?seed=7&{SMALL}&lidar=0")
    assert find(reorder(without_lidar, lambda frame: frame + 1)) == []
