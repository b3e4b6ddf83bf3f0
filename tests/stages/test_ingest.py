"""Ingest on the fake log: contracts, values, and logs as the world delivers them."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from genre_tasks.config import IngestConfig
from genre_tasks.errors import ConfigError, InputError
from genre_tasks.log_checks.check_log import check_log
from genre_tasks.scene.chunk import MOST_FRAMES, NO_SWEEP, Chunk, LogIssue
from genre_tasks.scene.facade_completion import STEP_M
from genre_tasks.stages.ingest import chunk_count, ingest
from genre_tasks.stages.ingest_views import _fill_times
from tests.fakes import SENSOR_HEIGHT_M, WALL_HEIGHT_M, FakeLog

CONFIG = IngestConfig(width_px=96, height_px=64)


@pytest.fixture(scope="module")
def log() -> FakeLog:
    return FakeLog()


@pytest.fixture(scope="module")
def chunk(log: FakeLog) -> Chunk:
    return ingest(CONFIG, log, 0)


def _kinds(marks: tuple[LogIssue, ...]) -> list[str]:
    return [m.kind for m in marks]


def test_roles_views_and_origin(log: FakeLog, chunk: Chunk) -> None:
    assert chunk_count(CONFIG, log) == 1 and chunk.frames == tuple(range(20)) and chunk.log_issues == ()
    assert {v.frame for v in chunk.views_with_role("source")} == {0, 4, 8, 12, 16}
    assert len(chunk.views_with_role("heldout")) == 30
    assert [(v.frame, v.camera) for v in chunk.views[:3]] == [(0, "front"), (0, "left"), (1, "front")]
    assert np.array_equal(chunk.world_SE3_chunk[:3, :3], np.eye(3))
    assert np.allclose(chunk.chunk_SE3_ego[10, :3, 3], 0) and np.allclose(chunk.world_SE3_chunk[:3, 3], [3, 0, 1.8])
    assert chunk.views[0].image == log.image_bytes("front", 0)


def test_points_lie_on_the_world_and_have_its_colours(chunk: Chunk) -> None:
    world = chunk.static.positions + chunk.world_SE3_chunk[:3, 3]
    known = np.stack([np.abs(world[:, 2]), np.abs(np.abs(world[:, 1]) - 8), np.abs(np.abs(world[:, 0]) - 45)]).min(0)
    parked = (np.abs(world - [14.0, -4.0, 0.75]) < [2.01, 0.91, 0.76]).all(1)
    returns = ~parked & (chunk.static.frames != NO_SWEEP)
    assert (known[returns] < 0.02).mean() > 0.999
    filled = chunk.static.frames == NO_SWEEP
    assert filled.sum() > 1000 and np.percentile(known[filled], 99) < 0.05, "on the road and on the walls"
    above = filled & (world[:, 2] > 1)
    assert above.sum() > 100 and world[above, 2].max() < WALL_HEIGHT_M + STEP_M
    far_wall = (np.abs(world[:, 1] - 8) < 0.01) & (world[:, 2] > 0.5) & chunk.static.colored
    mean = chunk.static.colors[far_wall].mean(0) / 255
    assert np.allclose(mean, [0.7, 0.45, 0.3], atol=0.04)
    assert (chunk.static.colors[~chunk.static.colored] == 128).all()


def test_the_moving_car_is_an_actor_and_the_parked_one_is_not(chunk: Chunk) -> None:
    (actor,) = chunk.actors
    assert actor.track_id == "mover" and len(actor.frames) == 20
    # In the box frame its points lie on the box: not smeared along its way.
    inside = np.abs(actor.points.positions) < np.array(actor.size_m) / 2 + 0.02
    assert inside.all(1).mean() > 0.99
    assert actor.points.colored.mean() > 0.8
    assert (actor.points.colors[actor.points.colored].mean(0) / 255)[0] > 0.7, "it is red"
    for frame in (0, 19):
        pose = actor.chunk_SE3_box[frame]
        near = np.abs(chunk.static.positions[chunk.static.frames == frame] - pose[:3, 3])
        assert not (near < [1.9, 0.8, 0.6]).all(1).any(), "none of its points stay in the background"


def test_colours_come_from_source_views_only(log: FakeLog, chunk: Chunk) -> None:
    heldout = {(v.camera, v.frame): b"" for v in chunk.views_with_role("heldout")}
    other = log.with_(missing_images=frozenset(heldout))
    again = ingest(CONFIG, other, 0)
    assert np.array_equal(again.static.colors, chunk.static.colors)


def test_same_bytes_again(log: FakeLog, chunk: Chunk) -> None:
    again = ingest(CONFIG, log, 0)
    for name in ("positions", "colors", "colored", "frames"):
        assert np.array_equal(getattr(again.static, name), getattr(chunk.static, name))
        assert np.array_equal(getattr(again.actors[0].points, name), getattr(chunk.actors[0].points, name))


def test_cameras_that_take_turns_all_have_source_views(log: FakeLog) -> None:
    alternating = {("front" if frame % 2 else "left", frame) for frame in range(20)}
    out = ingest(CONFIG, log.with_(missing_images=frozenset(alternating)), 0)
    sources = {(view.camera, view.frame) for view in out.views_with_role("source")}
    assert sources == {("front", frame) for frame in (0, 4, 8, 12, 16)} | {("left", frame) for frame in (1, 9, 17)}
    assert {view.camera for view in out.views_with_role("heldout")} == {"front", "left"}
    assert "no_source_view" not in _kinds(out.log_issues)
    # The left wall has the colours that the left camera alone can tell.
    near_wall = (np.abs(out.static.positions[:, 1] - 8) < 0.01) & (np.abs(out.static.positions[:, 0]) < 2)
    assert out.static.colored[near_wall].any()


def test_a_camera_with_one_image_between_the_source_frames_is_named(log: FakeLog) -> None:
    missing = frozenset(("left", frame) for frame in range(20) if frame != 5)
    out = ingest(CONFIG, log.with_(missing_images=missing), 0)
    assert {view.camera for view in out.views_with_role("source")} == {"front"}
    assert [issue.camera for issue in out.log_issues if issue.kind == "no_source_view"] == ["left"]


def test_check_and_ingest_agree_on_source_frames_of_cameras_that_take_turns(log: FakeLog) -> None:
    # Frame 4 and those after it have no image: the left camera's frame 1 is the second source frame.
    missing = {(camera, frame) for camera in ("front", "left") for frame in range(4, 20)}
    missing |= {("front", 1), ("front", 2), ("front", 3), ("left", 0), ("left", 3)}
    other = log.with_(missing_images=frozenset(missing))
    assert "few_source_frames" not in {finding.word for finding in check_log(other).findings}
    assert {(v.camera, v.frame) for v in ingest(CONFIG, other, 0).views_with_role("source")} == {
        ("front", 0),
        ("left", 1),
    }


def test_missing_and_unreadable_parts_are_marked(log: FakeLog) -> None:
    broken = log.with_(
        missing_images=frozenset({("front", 4)}),
        corrupt_images=frozenset({("left", 5)}),
        missing_sweeps=frozenset({3}),
        unreadable_sweeps=frozenset({6}),
    )
    out = ingest(CONFIG, broken, 0)
    marks = {(m.kind, m.camera, m.frame) for m in out.log_issues}
    assert marks == {
        ("missing_image", "front", 4),
        ("unreadable_image", "left", 5),
        ("missing_sweep", None, 3),
        ("unreadable_sweep", None, 6),
    }
    assert len(out.views) == 38 and not {3, 6} & set(out.static.frames.tolist())


@pytest.mark.parametrize(
    ("fault", "where"),
    [
        ({"missing_images": frozenset({("front", 4)})}, {"camera": "front", "frame": 4}),
        ({"corrupt_images": frozenset({("left", 5)})}, {"camera": "left", "frame": 5}),
        ({"missing_sweeps": frozenset({3})}, {"frame": 3}),
        ({"unreadable_sweeps": frozenset({6})}, {"frame": 6, "file": "6.bin"}),
    ],
)
def test_strict_fails_and_says_where(log: FakeLog, fault: dict, where: dict) -> None:
    with pytest.raises(InputError) as caught:
        ingest(CONFIG.model_copy(update={"strict": True}), log.with_(**fault), 0)
    assert all(getattr(caught.value, name) == value for name, value in where.items())
    assert caught.value.remedy


def test_images_of_another_shape_are_left_out(log: FakeLog) -> None:
    lens = replace(log.lens, height_px=96)

    class Taller(FakeLog):
        @property
        def cameras(self) -> tuple:
            return tuple(replace(c, lens=lens) for c in super().cameras)

    with pytest.raises(InputError, match=r"0 source frames.*16 images are left out.*96×64.*lens is 96×96"):
        ingest(CONFIG, Taller(frame_count=8), 0)


def test_a_frame_that_points_cannot_number_is_refused() -> None:
    with pytest.raises(InputError, match="more than 32,768 frames") as caught:
        ingest(CONFIG, FakeLog(frame_count=MOST_FRAMES + 1), MOST_FRAMES // CONFIG.chunk_frames)
    assert "Divide the log" in caught.value.remedy


def test_short_last_chunk(log: FakeLog) -> None:
    longer = log.with_(frame_count=26)
    out = ingest(CONFIG, longer, 1)
    assert chunk_count(CONFIG, longer) == 2 and out.frames == tuple(range(20, 26))
    assert {v.frame for v in out.views_with_role("source")} == {20, 24}


def test_fewer_than_two_source_frames(log: FakeLog) -> None:
    with pytest.raises(InputError, match="1 source frames") as caught:
        ingest(CONFIG, log.with_(frame_count=23), 1)
    assert caught.value.chunk == 1 and "--chunks" in caught.value.remedy and "source_every" in caught.value.remedy


@pytest.mark.parametrize(
    ("lost", "sources"),
    [((), {0, 4}), ((0,), {1, 4}), ((4,), {0, 5}), ((0, 1, 2, 3), {4}), ((4, 5, 6, 7), {0}), ((0, 4), {1, 5})],
)
def test_a_source_frame_without_images_is_replaced_by_the_next_one(lost: tuple[int, ...], sources: set[int]) -> None:
    """Report: none found; case 3 of the list of odd logs. The check and the run agree which chunks are lost."""
    missing = frozenset((camera, frame) for camera in ("front", "left") for frame in lost)
    log = FakeLog(frame_count=8, width_px=48, height_px=32, lidar_azimuths=360, missing_images=missing)
    found = {finding.word: finding for finding in check_log(log).findings}
    if len(sources) < 2:
        with pytest.raises(InputError, match="1 source frames"):
            ingest(CONFIG, log, 0)
        assert found["few_source_frames"].severity == "fatal"
        return
    assert {view.frame for view in ingest(CONFIG, log, 0).views_with_role("source")} == sources
    assert "few_source_frames" not in found


def test_unknown_chunk_and_camera(log: FakeLog) -> None:
    with pytest.raises(ConfigError, match="no chunk 1"):
        ingest(CONFIG, log, 1)
    with pytest.raises(ConfigError, match=r"unknown cameras rear.*front, left"):
        ingest(CONFIG.model_copy(update={"cameras": ("front", "rear")}), log, 0)


def test_one_camera_and_no_cuboids(log: FakeLog) -> None:
    out = ingest(CONFIG.model_copy(update={"cameras": ("left",)}), log.with_(without_tracks=True), 0)
    assert out.camera_names == ("left",) and out.actors == () and len(out.views) == 20 and out.static.colored.any()


def test_no_lidar_needs_points(log: FakeLog, tmp_path: Path) -> None:
    blind = log.with_(no_lidar=True, world_offset_m=(4e5, 4e6, 0.0))
    with pytest.raises(InputError, match="no LiDAR") as caught:
        ingest(CONFIG, blind, 0)
    assert "ingest.points=" in caught.value.remedy
    file = tmp_path / "points.ply"
    header = "ply\nformat ascii 1.0\nelement vertex 2\nproperty double x\nproperty double y\nproperty double z\n"
    body = "400020.5 4000008 1\n400020.5 4000007 1\n"
    file.write_text(header + "end_header\n" + body)
    out = ingest(CONFIG.model_copy(update={"points": str(file)}), blind, 0)
    assert np.allclose(out.static.positions, [[17.5, 8, 1 - SENSOR_HEIGHT_M], [17.5, 7, 1 - SENSOR_HEIGHT_M]])
    assert out.static.colored.all() and _kinds(out.log_issues) == ["actor_few_points"]


@pytest.mark.parametrize(("scale", "shift_m", "reason"), [(1.0, 5000.0, "an offset"), (1000.0, 0.0, "another unit")])
def test_points_far_from_the_path_are_refused(
    log: FakeLog, tmp_path: Path, scale: float, shift_m: float, reason: str
) -> None:
    points = scale * np.random.default_rng(1).uniform(1.0, 60.0, (400, 3)) + [shift_m, 0.0, 0.0]
    header = "ply\nformat ascii 1.0\nelement vertex 400\nproperty double x\nproperty double y\nproperty double z\n"
    file = tmp_path / "points.ply"
    file.write_text(header + "end_header\n" + "\n".join(" ".join(map(str, row)) for row in points.tolist()) + "\n")
    config = CONFIG.model_copy(update={"points": str(file)})
    with pytest.raises(
        InputError, match=f"0 of 400 points lie within 100 m .* median distance is .*{reason}"
    ) as caught:
        ingest(config, log.with_(no_lidar=True), 0)
    assert caught.value.file == str(file) and "ingest.placement" in caught.value.remedy
    placement = config.placement.model_copy(update={"scale": 1 / scale})
    if not shift_m:
        assert len(ingest(config.model_copy(update={"placement": placement}), log, 0).static.positions) == 400


def test_progress_rises_to_the_end(log: FakeLog) -> None:
    calls: list[tuple[int, int]] = []
    ingest(CONFIG, log, 0, lambda done, total, note="": calls.append((done, total)))
    assert calls == sorted(calls) and calls[-1] == (60, 60) and len(calls) > 20


def test_an_image_whose_time_cannot_be_read_costs_no_chunk(log: FakeLog, monkeypatch: pytest.MonkeyPatch) -> None:
    def read_time(self: FakeLog, camera: str, frame: int) -> float:
        if camera == "left" and frame in (0, 3):
            raise InputError("no number", remedy="Write seconds.")
        return self.frame_timestamp_s(frame)

    monkeypatch.setattr(FakeLog, "camera_timestamp_s", read_time)
    chunk = ingest(CONFIG, log, 0)
    assert [issue.frame for issue in chunk.log_issues if issue.kind == "missing_timestamp"] == [0, 3]
    at = {view.frame: view.timestamp_s for view in chunk.views if view.camera == "left"}
    assert at[3] == pytest.approx(log.frame_timestamp_s(3), abs=1e-6) and 0 in at
    with pytest.raises(InputError, match="frames 0, 3 have no finite time"):
        ingest(CONFIG.model_copy(update={"strict": True}), log, 0)


def test_an_image_without_a_time_takes_that_of_its_neighbours(log: FakeLog, monkeypatch: pytest.MonkeyPatch) -> None:
    def read_time(self: FakeLog, camera: str, frame: int) -> float:
        return float("nan") if camera == "left" and frame in (3, 4) else self.frame_timestamp_s(frame)

    monkeypatch.setattr(FakeLog, "camera_timestamp_s", read_time)
    for view in ingest(CONFIG, log, 0).views:
        assert view.timestamp_s == pytest.approx(log.frame_timestamp_s(view.frame), abs=1e-6)
    monkeypatch.setattr(FakeLog, "camera_timestamp_s", lambda self, camera, frame: float("nan"))
    times = [view.timestamp_s for view in ingest(CONFIG, log, 0).views if view.camera == "left"]
    assert np.diff(times) == pytest.approx(0.1)


def test_images_at_the_ends_without_a_time_are_those_of_their_sweeps(monkeypatch: pytest.MonkeyPatch) -> None:
    """The nearest image's time for all of them would double what is measured of their velocity."""
    missing = {0, 1, 2, 18, 19}

    def read_time(self: FakeLog, camera: str, frame: int) -> float:
        return float("nan") if camera == "left" and frame in missing else self.frame_timestamp_s(frame) + 0.03

    monkeypatch.setattr(FakeLog, "camera_timestamp_s", read_time)
    # A vehicle's sweeps with a dropped frame: times on a line would be wrong.
    log = FakeLog(timestamps_s=tuple(0.1 * (frame + (frame > 18)) for frame in range(20)))
    for view in ingest(CONFIG, log, 0).views:
        assert view.timestamp_s == pytest.approx(log.frame_timestamp_s(view.frame) + 0.03, abs=1e-6)


def test_a_camera_without_any_time_has_those_of_the_sweeps(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(FakeLog, "camera_timestamp_s", lambda self, camera, frame: float("nan"))
    log = FakeLog(timestamps_s=tuple(100.0 + 0.5 * frame for frame in range(20)))
    for view in ingest(CONFIG, log, 0).views:
        assert view.timestamp_s == pytest.approx(100.0 + 0.5 * view.frame, abs=1e-6)


@pytest.mark.parametrize(
    ("times", "expected"),
    [
        ({12: 6.0, 13: 6.2, 15: 7.0}, [5.6, 5.8, 6.0, 6.2, 6.6, 7.0, 7.4]),
        ({12: 6.0}, [5.8, 5.9, 6.0, 6.1, 6.2, 6.3, 6.4]),
        ({}, [1.0, 1.1, 1.2, 1.3, 1.4, 1.5, 1.6]),
    ],
)
def test_without_times_of_sweeps_the_line_of_the_others_goes_on(times: dict[int, float], expected: list[float]) -> None:
    frames = range(10, 17)
    known = np.array([times.get(frame, np.nan) for frame in frames])
    assert _fill_times(frames, known, np.full(7, np.nan)) == pytest.approx(expected)


class LogWithAWrongPose(FakeLog):
    """Frame 7 lies at the origin of a map."""

    def world_SE3_lidar(self, frame: int) -> np.ndarray:
        pose = super().world_SE3_lidar(frame)
        pose[:2, 3] += [-5e5, 4e6] if frame == 7 else [0.0, 0.0]
        return pose


def test_a_pose_far_away_is_named_with_its_frame() -> None:
    with pytest.raises(InputError, match=r"the chunk.s path spans 4000000 m") as caught:
        ingest(CONFIG, LogWithAWrongPose(), 0)
    assert caught.value.where == "log street, chunk 0, frame 7"
    assert caught.value.problem.endswith("and this frame lies 4031129 m from its median position")
    assert caught.value.remedy.startswith("Correct the pose of this frame, leave the chunk out")
