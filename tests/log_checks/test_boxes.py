"""Boxes in another unit, order or frame, in growing strength, and those of real classes."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from genre_tasks.logs.findings import Finding
from genre_tasks.logs.pandaset.cuboids import build_tracks, read_boxes
from genre_tasks.logs.pandaset.pickle_reader import Table
from genre_tasks.logs.types import CuboidTrack, Float64
from tests.fakes import yaw_pose
from tests.log_checks.edited_log import EditedLog, assess, is_complete, street
from tests.logs.pandaset_folder import cuboids

Size = tuple[float, float, float]


def with_tracks(change: Callable[[CuboidTrack], CuboidTrack], **street_changes: object) -> dict[str, Finding]:
    log = street(**street_changes)
    return assess(EditedLog(log, tracks=lambda: tuple(change(track) for track in log.tracks())))


def with_boxes(change: Callable[[int, Float64], Float64], **street_changes: object) -> dict[str, Finding]:
    """What is found where every box has another pose."""

    def move(track: CuboidTrack) -> CuboidTrack:
        boxes = [change(int(frame), box) for frame, box in zip(track.frames, track.world_SE3_box, strict=True)]
        return replace(track, world_SE3_box=np.stack(boxes))

    return with_tracks(move, **street_changes)


def with_size(label: str, size_m: Size) -> dict[str, Finding]:
    """What is found where all boxes have a label and a size; where they lie is another finding."""
    return with_tracks(lambda track: replace(track, label=label, size_m=size_m), no_lidar=True)


# Medians and extremes of PandaSet 002, and of a log of Argoverse 2.
@pytest.mark.parametrize(
    ("label", "size_m"),
    [
        ("Car", (4.48, 1.93, 1.67)),
        ("Car", (3.06, 1.71, 1.29)),
        ("Car", (5.25, 2.2, 2.4)),
        ("Medium-sized Truck", (6.46, 3.12, 3.18)),
        ("Other Vehicle - Construction Vehicle", (11.01, 4.12, 7.54)),
        ("Pedestrian with Object", (0.88, 0.65, 1.81)),
        ("Pedestrian", (1.38, 0.86, 1.82)),
        ("Pedestrian", (0.53, 0.61, 1.49)),
        ("Cones", (0.33, 0.28, 0.66)),
        ("Motorcycle", (1.82, 0.8, 1.75)),
        ("REGULAR_VEHICLE", (6.18, 3.0, 2.52)),
        ("REGULAR_VEHICLE", (4.03, 1.74, 1.41)),
        ("BOLLARD", (0.16, 0.15, 0.94)),
        ("PEDESTRIAN", (0.6, 0.6, 2.13)),
        ("vehicle.bus.bendy", (18.0, 3.0, 3.5)),
        ("vehicle.bicycle", (1.7, 0.6, 1.3)),
        ("Tram", (40.0, 2.7, 3.6)),
    ],
)
def test_sizes_of_real_boxes(label: str, size_m: Size) -> None:
    assert with_size(label, size_m) == {}


@pytest.mark.parametrize("label", ["Car", "car", "vehicle.car", "TYPE_VEHICLE", "REGULAR_VEHICLE"])
@pytest.mark.parametrize(
    ("factor", "unit"),
    [
        (100.0, "centimetres"),
        (1000.0, "millimetres"),
        (3.281, "feet"),
        (39.37, "inches"),
        (0.5, "half sizes"),
        (0.01, "centimetres"),
    ],
)
def test_cars_in_other_units(label: str, factor: float, unit: str) -> None:
    """Report: VCCIV/BLVD#2 (lengths and widths are halves), tianqi-wang1996/DeepAccident#13 (the unit of boxes)."""
    found = with_size(label, (4.5 * factor, 1.9 * factor, 1.6 * factor))
    assert set(found) == {"odd_box_size"} and unit in found["odd_box_size"].remedy
    assert is_complete(found["odd_box_size"]) and found["odd_box_size"].severity == "warning"


@pytest.mark.parametrize("factor", [0.5, 3.281, 100.0])
def test_pedestrians_in_other_units(factor: float) -> None:
    """Report: VCCIV/BLVD#2."""
    assert set(with_size("Pedestrian", (0.7 * factor, 0.7 * factor, 1.75 * factor))) == {"odd_box_size"}


@pytest.mark.parametrize("size_m", [(450.0, 180.0, 150.0), (0.005, 1.0, 1.0)])
def test_boxes_of_no_known_class(size_m: Size) -> None:
    """Report: tianqi-wang1996/DeepAccident#13."""
    assert set(with_size("Thing", size_m)) == {"odd_box_size"}


def test_length_and_width_in_the_other_order() -> None:
    """Report: open-edge-platform/datumaro#1578, open-mmlab/mmdetection3d#2360."""
    found = with_tracks(lambda track: replace(track, size_m=(1.9, 4.5, 1.6)), no_lidar=True)
    assert set(found) == {"odd_box_size"} and "Length and width look swapped" in found["odd_box_size"].remedy


def test_sizes_that_are_no_numbers_are_passed_over() -> None:
    assert with_tracks(lambda track: replace(track, size_m=(4.0, float("nan"), 1.5)), no_lidar=True) == {}


def turned(degrees: float) -> dict[str, Finding]:
    turn = yaw_pose(np.deg2rad(degrees), (0.0, 0.0, 0.0))
    return with_boxes(lambda frame, box: box @ turn, no_lidar=True)


def test_headings_of_what_drives() -> None:
    """Report: tyagi-iiitv/PointPillars#4 (yaw in degrees); open-mmlab/mmdetection3d#778 (yaw minus a quarter turn)."""
    assert turned(0.0) == turned(30.0) == turned(-30.0) == {}
    for degrees in (60.0, 90.0, -90.0, 120.0):
        found = turned(degrees)
        assert set(found) == {"odd_box_heading"} and is_complete(found["odd_box_heading"])
    assert "swapped" in turned(90.0)["odd_box_heading"].message
    assert "degrees" in turned(60.0)["odd_box_heading"].message
    assert turned(180.0)["odd_box_heading"].severity == "note"


@pytest.mark.parametrize(("yaw", "fires"), [(3.1, False), (-6.2, False), (12.0, False), (45.0, True), (-180.0, True)])
def test_yaw_in_degrees_is_seen_in_the_file(yaw: float, fires: bool) -> None:
    """Report: tyagi-iiitv/PointPillars#4."""
    table = Table(cuboids({"yaw": yaw}, {"uuid": "b"}), 2)
    _, findings = build_tracks([read_boxes(table, 0, file=Path("00.pkl.gz"), log="log")], "log")
    assert [finding.word for finding in findings] == (["odd_box_yaw"] if fires else [])


@pytest.mark.parametrize(("speed", "fires"), [(0.0, False), (60.0, False), (100.0, True)])
def test_speeds_of_tracks(speed: float, fires: bool) -> None:
    """Report: none found; boxes in case 6 of the list of odd logs."""

    def move(frame: int, box: Float64) -> Float64:
        out = box.copy()
        out[0, 3] += speed * 0.1 * frame
        return out

    found = with_boxes(move, no_lidar=True, cars=street().cars[:1])
    assert ("implausible_track_speed" in found) == fires
    assert all(is_complete(finding) for finding in found.values())


def test_boxes_in_the_frame_of_the_vehicle_move_with_it() -> None:
    """Report: lyft/nuscenes-devkit#35, Thinklab-SJTU/Bench2Drive#23 (boxes in the frame of the vehicle)."""
    log = street()
    found = with_boxes(lambda frame, box: np.linalg.inv(log.world_SE3_lidar(frame)) @ box)
    assert "moving_static_boxes" in found and is_complete(found["moving_static_boxes"])


@pytest.mark.parametrize("offset_m", [(0.0, 0.0, 0.0), (400.0, -300.0, 20.0)])
def test_boxes_without_points(offset_m: tuple[float, float, float]) -> None:
    """Report: lyft/nuscenes-devkit#35 (boxes do not fit the LiDAR points)."""
    log = street(world_offset_m=offset_m)
    found = with_boxes(lambda frame, box: np.linalg.inv(log.world_SE3_lidar(frame)) @ box, world_offset_m=offset_m)
    assert "the LiDAR's frame" in found["boxes_without_points"].remedy and is_complete(found["boxes_without_points"])
    assert assess(log) == {}


@pytest.mark.parametrize(("shift_m", "fires"), [(0.1, False), (0.5, False), (6.0, True)])
def test_boxes_next_to_their_points(shift_m: float, fires: bool) -> None:
    """Report: szenergy/formula_student_packages#13 (boxes next to the points)."""

    def move(frame: int, box: Float64) -> Float64:
        out = box.copy()
        out[0, 3] += shift_m
        return out

    assert ("boxes_without_points" in with_boxes(move)) == fires


@pytest.mark.parametrize(("shift_m", "fires"), [(-0.75, True), (-0.2, False), (0.0, False), (0.2, False), (0.75, True)])
def test_boxes_above_or_below_the_road(shift_m: float, fires: bool) -> None:
    """Report: open-mmlab/OpenPCDet#128, ch-sa/labelCloud#73 (the origin of KITTI's boxes is at the bottom)."""

    def move(frame: int, box: Float64) -> Float64:
        out = box.copy()
        out[2, 3] += shift_m
        return out

    found = with_boxes(move)
    assert set(found) == ({"boxes_off_ground"} if fires else set())
    assert all("half their height" in f.remedy and is_complete(f) for f in found.values())


def test_few_boxes_and_no_lidar_are_no_evidence() -> None:
    log = street(cars=street().cars[:3])
    moved = EditedLog(log, tracks=lambda: street(cars=street().cars[3:]).tracks())
    assert assess(moved) == {}
    assert assess(street(no_lidar=True)) == assess(street(missing_sweeps=frozenset(range(5, 8)))) == {}


def test_tracks_of_other_frames_are_passed_over() -> None:
    nowhere = np.full((2, 4, 4), np.nan)
    outside = CuboidTrack("x", "car", np.array([30, 31]), np.stack([np.eye(4)] * 2), (400.0, 1.0, 1.0), False)
    unknown = CuboidTrack("y", "car", np.array([2, 3]), nowhere, (4.0, 1.8, 1.5), False)
    assert assess(street(extra_tracks=(outside, unknown))) == {}
