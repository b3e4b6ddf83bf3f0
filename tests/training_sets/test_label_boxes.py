"""Boxes in images against cases computed by hand, and against a ray-cast street."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from genre_tasks.errors import InputError
from genre_tasks.logs.types import CuboidTrack, Lens
from genre_tasks.scene.projection import project
from genre_tasks.training_sets.box_outlines import box_corners, find_boxes_in_view, measure_occlusion, outline_box
from genre_tasks.training_sets.label_boxes import (
    LogLabeller,
    count_points_in_boxes,
    labeller_of,
)
from genre_tasks.training_sets.label_filter import keep_visible_boxes
from genre_tasks.training_sets.labelled_images import LabelledBox, LabelledImage
from genre_tasks.training_sets.rectified_images import rectify_labelled_image
from tests.fakes import FakeCar, FakeLog
from tests.training_sets.labelled_street import FORWARD, LENS, LOG, chunk_of, distorted, label_street

BARREL = (-0.25, 0.05, 0.001, -0.002, 0.0)


def pose(x: float, y: float, z: float, turn: float = 0.0) -> np.ndarray:
    """camera_SE3_box of an object that drives away, turned to the left."""
    c, s = math.cos(turn), math.sin(turn)
    out = np.eye(4)
    out[:3, :3] = FORWARD @ np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
    out[:3, 3] = x, y, z
    return out


def outline(placed: np.ndarray, size: tuple[float, float, float], lens: Lens = LENS):
    return outline_box(box_corners(placed, np.array(size)), lens)


def find(image: LabelledImage, track_id: str) -> LabelledBox:
    return next(box for box in image.boxes if box.track_id == track_id)


def test_a_box_ahead_has_the_rectangle_of_its_near_face() -> None:
    found = outline(pose(0, 0, 10), (4, 2, 2))
    assert found.box_px == pytest.approx((37.5, 37.5, 62.5, 62.5)) and found.truncated == 0


def test_a_turned_box_has_the_rectangle_of_its_corners() -> None:
    found = outline(pose(0, 0, 10, math.pi / 4), (4, 2, 2))
    r = math.sqrt(0.5)
    # Turned left, the front left corner is leftmost and farther away; the rear right one is rightmost and nearer.
    left = 50 - 100 * (3 * r) / (10 + r)
    right = 50 + 100 * (3 * r) / (10 - r)
    height = 100 / (10 - 3 * r)
    assert found.box_px == pytest.approx((left, 50 - height, right, 50 + height))


def test_what_is_outside_of_the_image_is_cut_off() -> None:
    # The near face is 2 m wide at 10 m, half of it to the right of the image's edge at x = 5 m.
    found = outline(pose(5, 0, 11), (2, 2, 2))
    left = 50 + 100 * 4 / 12
    assert found.box_px == pytest.approx((left, 40, 100, 60))
    assert found.truncated == pytest.approx(1 - (100 - left) / (110 - left))


def test_a_box_next_to_the_camera_is_cut_at_the_camera_plane() -> None:
    # From 5 m behind to 5 m ahead, its inner face 2 m to the right: at the image's edge that face is at 4 m.
    found = outline(pose(3, 0, 0), (10, 2, 2))
    assert found.box_px == pytest.approx((90, 25, 100, 75))
    assert 0.99 < found.truncated < 1


@pytest.mark.parametrize("place", [(0, 0, -10), (30, 0, 10), (-30, 0, 10), (0, 30, 10), (0, -30, 10), (3, 0, -2)])
def test_what_no_pixel_shows_has_no_outline(place: tuple[float, float, float]) -> None:
    corners = box_corners(pose(*place), np.array([4.0, 2.0, 2.0]))
    assert outline_box(corners, LENS) is None
    assert outline_box(corners, replace(LENS, distortion=BARREL)) is None


def test_the_fast_search_leaves_out_nothing() -> None:
    rng = np.random.default_rng(0)
    poses = np.stack([pose(*rng.uniform(-15, 15, 3), rng.uniform(-3, 3)) for _ in range(400)])
    corners = box_corners(poses, rng.uniform(0.5, 12, (400, 3)))
    shown = {k for k in range(400) if outline_box(corners[k], LENS)}
    assert 40 < len(shown) < 300 and shown <= set(find_boxes_in_view(corners, LENS).tolist())


def test_a_distorted_rectangle_is_that_of_the_projected_surface() -> None:
    lens = replace(LENS, distortion=BARREL)
    size = np.array([4.0, 2.0, 2.0])
    rng = np.random.default_rng(1)
    faces = rng.uniform(-0.5, 0.5, (60_000, 3))
    faces[np.arange(60_000), rng.integers(0, 3, 60_000)] = rng.choice([-0.5, 0.5], 60_000)
    for placed in (pose(-3, 1, 9, 0.5), pose(3.5, -1, 8, 2.0)):
        points = (faces * size) @ placed[:3, :3].T + placed[:3, 3]
        uv = project(points.astype(np.float32), np.eye(4), lens).uv
        assert outline_box(box_corners(placed, size), lens).box_px == pytest.approx((*uv.min(0), *uv.max(0)), abs=0.3)
        # Straight lines between corners would miss the rectangle of the same box by far more.
        straight = outline_box(box_corners(placed, size), LENS).box_px
        assert np.abs(np.subtract(straight, (*uv.min(0), *uv.max(0)))).max() > 1


def test_half_a_face_behind_a_nearer_surface_is_half_hidden() -> None:
    depth = np.full((100, 100), 50.0, np.float32)
    size = np.array([4.0, 2.0, 2.0])
    assert measure_occlusion(pose(0, 0, 10), size, LENS, depth) == 0
    depth[:, :50] = 5.0
    assert measure_occlusion(pose(0, 0, 10), size, LENS, depth) == 0.5
    # The object's own surface lies in the box, behind its near face at 8 m; where nothing is, the depth is 0.
    depth[:] = 8.1
    depth[:, 50:] = 0.0
    assert measure_occlusion(pose(0, 0, 10), size, LENS, depth) == 0
    assert math.isnan(measure_occlusion(pose(0, 0, -10), size, LENS, depth))
    # Of a box 2 m wide at 4 m, the image shows a strip of 4 cm, between the points of the coarse grid.
    strip = pose(2.96, 0, 6)
    assert outline(strip, (4, 2, 2)).box_px[0] < 100
    assert measure_occlusion(strip, size, LENS, np.full((100, 100), 1.0, np.float32)) == 1


def test_points_are_counted_in_turned_boxes() -> None:
    rng = np.random.default_rng(2)
    points = rng.uniform(-10, 10, (20_000, 3)) + 1e6
    poses = np.stack([np.eye(4)] * 8)
    poses[:, :3, :3] = [pose(0, 0, 0, turn)[:3, :3] for turn in rng.uniform(-3, 3, 8)]
    poses[:, :3, 3] = rng.uniform(-8, 8, (8, 3)) + 1e6
    sizes = rng.uniform(0.5, 6, (8, 3))
    local = [(points - p[:3, 3]) @ p[:3, :3] for p in poses]
    expected = [int((np.abs(x) <= s / 2).all(1).sum()) for x, s in zip(local, sizes, strict=True)]
    assert count_points_in_boxes(points, poses, sizes).tolist() == expected and max(expected) > 20


def test_the_street_is_labelled_where_its_cars_are() -> None:
    image = next(i for i in label_street() if (i.camera, i.frame) == ("front", 1))
    assert {box.track_id for box in image.boxes} == {"mover", "parked", "far"}
    mover = find(image, "mover")
    # The camera is 0.3 m ahead of the LiDAR and 0.2 m below it; the vehicle drives 3 m/s, the car 6 m/s.
    assert mover.camera_SE3_box[:3, 3] == pytest.approx([-3.5, 1.6 - 0.75, 6.6 - 0.3 - 0.3], abs=1e-6)
    assert mover.velocity_m_s == pytest.approx((0, 0, 6), abs=1e-6) and math.isnan(mover.occluded)
    assert find(image, "parked").velocity_m_s == pytest.approx((0, 0, 0), abs=1e-6)
    red = image.image[..., 0].astype(int) - image.image[..., 2]
    left, top, right, bottom = (round(edge) for edge in mover.box_px)
    # In this half of the image the car alone is red: its pixels touch all sides of its rectangle.
    rows, columns = np.nonzero(red[:, :45] > 130)
    assert abs(columns.min() - left) <= 1 and abs(columns.max() + 1 - right) <= 1
    assert abs(rows.min() - top) <= 1 and abs(rows.max() + 1 - bottom) <= 1
    assert mover.lidar_points > 30


def test_boxes_move_against_the_camera() -> None:
    recorded = {(i.camera, i.frame): i for i in label_street()}
    for moved in label_street(shifts_m=(3.0, -1.5), recorded=False):
        before = recorded[moved.camera, moved.frame]
        expected = [0, 3, 0] if moved.shift_m == 3 else [0, -1.5, 0]
        assert moved.world_SE3_camera[:3, 3] - before.world_SE3_camera[:3, 3] == pytest.approx(expected, abs=1e-6)
        assert moved.world_SE3_ego[:3, 3] - before.world_SE3_ego[:3, 3] == pytest.approx(expected, abs=1e-6)
        for box in moved.boxes:
            world = moved.world_SE3_camera @ box.camera_SE3_box
            track = next(t for t in LOG.tracks() if t.track_id == box.track_id)
            assert world == pytest.approx(track.world_SE3_box[moved.frame], abs=1e-6)
    sides = {i.shift_m: find(i, "far").box_px for i in label_street(shifts_m=(3.0, -3.0)) if i.camera == "front"}
    assert sides[3.0][0] > sides[0.0][0] > sides[-3.0][0]


def test_a_car_behind_another_is_hidden() -> None:
    cars = (FakeCar("near", 8.0, 0.0, size_m=(4.0, 2.2, 1.9)), FakeCar("behind", 16.0, 0.0))
    log = FakeLog(frame_count=2, cars=cars, camera_names=("front",))
    image = label_street(log, (0.0,), recorded=False)[0]
    assert find(image, "near").occluded == 0 and find(image, "behind").occluded > 0.95
    assert [box.track_id for box in keep_visible_boxes(image, min_points=0).boxes] == ["near"]
    aside = label_street(log, (4.0,), recorded=False)[0]
    assert find(aside, "behind").occluded < 0.6


def test_boxes_without_points_are_left_out_but_not_those_of_frames_without_sweeps() -> None:
    extra = replace(LOG, missing_sweeps=frozenset({2}), _images={})
    images = [i for i in label_street(extra) if i.camera == "front"]
    assert {box.lidar_points for box in images[2].boxes} == {-1}
    assert len(keep_visible_boxes(images[2]).boxes) == 3
    few = min(box.lidar_points for box in images[0].boxes)
    assert len(keep_visible_boxes(images[0], few + 1).boxes) == 2


def test_a_camera_in_a_car_does_not_see_it() -> None:
    inside = FakeLog(
        frame_count=2, cars=(FakeCar("around", 0.3, 3.0, size_m=(4.0, 2.0, 3.0)),), camera_names=("front",)
    )
    image = label_street(inside, (3.0,), recorded=False)[0]
    assert image.boxes == ()


def test_a_log_has_one_labeller_that_counts_a_frame_once(monkeypatch: pytest.MonkeyPatch) -> None:
    log = replace(LOG, uri="fake:counted", _images={})
    chunk = chunk_of(log)
    read: list[int] = []
    original = FakeLog.sweep
    monkeypatch.setattr(FakeLog, "sweep", lambda self, frame: (read.append(frame), original(self, frame))[1])
    for view in chunk.views:
        one = labeller_of(log).label_recorded_image(chunk, view)
        other = labeller_of(log).label_view(chunk, view, one.image, shift_m=0.0, rendered=False, depth=None)
        assert [box.box_px for box in one.boxes] == [box.box_px for box in other.boxes]
        assert one.timestamp_s == view.timestamp_s and one.lens == view.lens
    assert sorted(read) == list(chunk.frames)


def test_between_annotations_boxes_stand_where_scenes_have_the_object() -> None:
    log = replace(LOG, uri="fake:every third", track_every=3, _images={})
    exact = {(i.camera, i.frame): i for i in label_street()}
    for image in label_street(log):
        for box in image.boxes:
            expected = find(exact[image.camera, image.frame], box.track_id)
            assert box.camera_SE3_box == pytest.approx(expected.camera_SE3_box, abs=1e-6)
            assert box.velocity_m_s == pytest.approx(expected.velocity_m_s, abs=1e-6)
    assert {i.frame for i in label_street(log) if i.boxes} == {0, 1, 2, 3}


def test_velocities_bridge_no_gap_that_poses_do_not() -> None:
    frames = np.array([0, 1, 13, 14, 25])
    poses = np.stack([np.eye(4)] * 5)
    poses[:, :3, 3] = [(x, 4.0, 1.0) for x in (12.0, 13.0, 20.0, 20.5, 32.0)]
    gap = CuboidTrack("gap", "car", frames, poses, (4.0, 1.8, 1.5), moving=True)
    alone = CuboidTrack("alone", "car", frames[[0, 2]], poses[[0, 2]], (4.0, 1.8, 1.5), moving=True)
    empty = FakeLog(frame_count=26, cars=(), camera_names=("front",))
    labeller = LogLabeller(replace(empty, extra_tracks=(gap, alone)))
    speeds = {}
    for view in [v for v in chunk_of(empty).views if v.frame in (1, 13, 14)]:
        for box in labeller.label_recorded_image(chunk_of(empty), view).boxes:
            speeds[view.frame, box.track_id] = box.velocity_m_s[2]
    # From the near side alone; a neighbour as far as poses are interpolated counts; without any it stands.
    expected = {(1, "gap"): 10.0, (13, "gap"): 5.0, (14, "gap"): 10.0, (13, "alone"): 0.0}
    assert speeds == pytest.approx(expected, abs=1e-6)


def test_a_sweep_or_a_time_that_cannot_be_read_costs_no_image(monkeypatch: pytest.MonkeyPatch) -> None:
    log = replace(LOG, uri="fake:unreadable", _images={})
    chunk = chunk_of(log)
    fail = InputError("row 7 is cut off", remedy="Copy the sweep.")

    def refuse(self: FakeLog, frame: int) -> object:
        raise fail

    monkeypatch.setattr(FakeLog, "sweep", refuse)
    monkeypatch.setattr(FakeLog, "frame_timestamp_s", refuse)
    labeller = LogLabeller(log)
    images = [labeller.label_recorded_image(chunk, view) for view in chunk.views]
    boxes = [box for image in images for box in image.boxes]
    assert boxes and {box.lidar_points for box in boxes} == {-1}
    assert {box.velocity_m_s for box in boxes} == {(0.0, 0.0, 0.0)}


def test_a_log_without_annotations_is_one_clear_error() -> None:
    log = FakeLog(without_tracks=True)
    with pytest.raises(InputError, match=r"has no annotations.*Choose a log with boxes"):
        LogLabeller(log)


def test_rectified_images_show_what_a_lens_without_distortion_shows() -> None:
    (image,) = [i for i in label_street(replace(LOG, _images={})) if (i.camera, i.frame) == ("front", 0)]
    lens = replace(image.lens, distortion=BARREL)
    u, v = np.meshgrid(np.arange(lens.width_px) + 0.5, np.arange(lens.height_px) + 0.5)
    bent = replace(image, lens=lens, image=np.stack([u, v, 0 * u], -1).astype(np.uint8))
    straight = rectify_labelled_image(bent)
    assert straight.lens == image.lens and [b.box_px for b in straight.boxes] == [b.box_px for b in image.boxes]
    # Each pixel of the ramp says where its colour came from: where the lens shows the pixel's ray.
    for row, column in ((10, 12), (32, 48), (50, 80)):
        ray = np.array([[(column + 0.5 - lens.cx_px) / lens.fx_px, (row + 0.5 - lens.cy_px) / lens.fy_px, 1.0]])
        uv = project(ray.astype(np.float32), np.eye(4), lens).uv[0]
        assert straight.image[row, column, :2] == pytest.approx(uv - 0.5, abs=1.01)
    assert rectify_labelled_image(image) is image
    assert len(distorted([image], BARREL)) == 1
