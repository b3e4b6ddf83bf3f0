"""What the check says of sound and of damaged logs."""

from __future__ import annotations

import io
import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from typer.testing import CliRunner

from flows.cli.main import app
from genre_tasks.log_checks.check_log import check_log
from genre_tasks.log_checks.results import LogCheck
from genre_tasks.log_checks.standstill import STANDSTILL_M
from genre_tasks.logs import registry
from genre_tasks.logs.findings import Finding
from genre_tasks.logs.pandaset.reader import open_pandaset
from genre_tasks.logs.pandaset.writer import write_pandaset
from genre_tasks.logs.registry import open_log
from genre_tasks.logs.types import Camera, Sweep
from genre_tasks.stages import ingest
from tests.fakes import FakeLog
from tests.log_checks.edited_log import EditedLog, with_ego
from tests.logs.pandaset_folder import edit_json, edit_table, small_log

REAL = Path(__file__).resolve().parents[3] / "shared/data/pandaset/002"


def log_of(**changes: object) -> FakeLog:
    return small_log().with_(lidar_azimuths=360, **changes)


def messages(check: LogCheck, severity: str) -> str:
    return " | ".join(f"{f.message} [{f.remedy}]" for f in check.findings if f.severity == severity)


def test_a_sound_log() -> None:
    check = check_log(log_of(frame_count=5, speed_mps=20.0), chunk_frames=5)
    assert check.verdict == "good" and check.findings == ()
    assert check.travel_m == pytest.approx(4 * 2.0)
    assert check.chunk_travel_m == pytest.approx((8.0,)) and check.chunk_count == 1
    assert check.duration_s == pytest.approx(0.4)
    assert (check.tracks_moving, check.tracks_static) == (1, 1)
    assert [(c.name, c.width_px, c.height_px) for c in check.cameras] == [("front", 48, 32), ("left", 48, 32)]
    least, median, most = check.points
    assert 1000 < least <= median <= most


def test_chunks_and_the_short_last_one() -> None:
    check = check_log(log_of(frame_count=8, speed_mps=20.0), chunk_frames=5)
    assert check.chunk_travel_m == pytest.approx((8.0, 4.0))
    assert "the last chunk is short: 3 of 5 frames" in messages(check, "note")
    assert "frames 5–7 cannot be reconstructed: a chunk needs at least 5" in messages(check, "note")
    assert check.verdict == "good"
    denser = check_log(log_of(frame_count=8, speed_mps=20.0), chunk_frames=5, source_every=2)
    assert "the last chunk is short" in messages(denser, "note") and "cannot" not in messages(denser, "note")
    lone = check_log(log_of(frame_count=4, speed_mps=20.0))
    assert lone.verdict == "unusable" and "a chunk needs at least 5" in messages(lone, "fatal")


def test_more_frames_than_can_be_numbered(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("genre_tasks.log_checks.check_log.MOST_FRAMES", 4)
    check = check_log(log_of(frame_count=5, speed_mps=20.0), chunk_frames=5)
    assert "chunks beyond the first 4 of 5 frames cannot be reconstructed" in messages(check, "warning")


def test_missing_things_are_named_by_frame() -> None:
    log = log_of(
        frame_count=6,
        speed_mps=20.0,
        missing_images=frozenset({("left", 1), ("left", 2), ("left", 3), ("left", 5)}),
        corrupt_images=frozenset({("front", 4)}),
        missing_sweeps=frozenset({2}),
        unreadable_sweeps=frozenset({3}),
    )
    check = check_log(log)
    front, left = check.cameras
    assert left.missing == (1, 2, 3, 5) and left.unreadable == ()
    assert front.unreadable == (4,) and front.missing == ()
    assert check.missing_sweeps == (2,) and check.unreadable_sweeps == (3,)
    assert check.verdict == "usable"
    warnings = messages(check, "warning")
    assert "left: no image at frames 1–3, 5" in warnings
    assert "front: unreadable images at frames 4" in warnings
    assert "no LiDAR sweep at frames 2" in warnings
    assert "cannot read the sweep (frame 3, file 3.bin) [Fetch the file again.]" in warnings


def test_sweeps_that_are_cut_off_are_named_by_frame() -> None:
    log = FakeLog(frame_count=6, speed_mps=20.0, lidar_azimuths=720)

    def sweep(frame: int) -> Sweep | None:
        found = log.sweep(frame)
        part = {1: 0, 4: len(found.points_world) // 5}.get(frame)
        return replace(
            found,
            points_world=found.points_world[:part],
            intensity=found.intensity[:part],
            timestamps_s=found.timestamps_s[:part],
        )

    (found,) = [f for f in check_log(EditedLog(log, sweep=sweep)).findings if f.word == "few_lidar_points"]
    assert found.frames == (1, 4) and "sweeps of frames 1, 4 have few points, down to 0" in found.message
    assert found.numbers["limit"] == 0.25 * found.numbers["median"] > 1000


def test_truncated_jpegs_and_odd_sizes() -> None:
    def encode(width: int, kind: str) -> bytes:
        stream = io.BytesIO()
        noise = np.random.default_rng(0).integers(0, 255, (32, width, 3), dtype=np.uint8)
        Image.fromarray(noise).save(stream, kind)
        return stream.getvalue()

    log = log_of()
    jpeg = encode(48, "JPEG")
    log._images.update({("front", 0): jpeg, ("front", 1): jpeg[: len(jpeg) // 2], ("front", 2): encode(40, "PNG")})
    log._images[("front", 3)] = b""
    (front, _) = check_log(log).cameras
    assert front.unreadable == (1, 3) and front.odd_size == (2,)


def test_no_lidar_is_fatal_and_says_what_to_give() -> None:
    check = check_log(log_of(no_lidar=True))
    assert check.verdict == "unusable" and check.points == (0, 0, 0)
    assert "ingest.points=FILE.ply" in messages(check, "fatal")


@pytest.mark.parametrize("no_lidar", [False, True])
def test_the_command_ends_with_1_where_a_log_is_unusable(monkeypatch: pytest.MonkeyPatch, no_lidar: bool) -> None:
    monkeypatch.setattr(registry, "open_log", lambda uri: log_of(no_lidar=no_lidar, frame_count=5, speed_mps=20.0))
    told, as_json = (CliRunner().invoke(app, ["check", "fake", *more]) for more in ((), ("--json",)))
    assert told.exit_code == as_json.exit_code == int(no_lidar)
    verdict = json.loads(as_json.stdout)["verdict"]
    assert verdict == ("unusable" if no_lidar else "good") and verdict in told.stdout


def test_no_cuboids_and_one_camera_are_survived() -> None:
    check = check_log(log_of(without_tracks=True, camera_names=("front",), speed_mps=20.0), source_every=1)
    assert check.verdict == "good"
    assert "no cuboids" in messages(check, "note") and "one camera only" in messages(check, "note")


def test_standstill() -> None:
    check = check_log(log_of(speed_mps=0.0), source_every=1)
    assert check.standstill_chunks == (0,) and check.verdict == "usable"
    assert "stands still (0.00 m)" in messages(check, "warning")


def test_creeping_is_no_standstill_and_noise_of_poses_is() -> None:
    """The check and ``ingest`` measure alike: the largest distance from the first position, with one limit."""
    assert ingest.STANDSTILL_M == STANDSTILL_M
    creeping = check_log(log_of(frame_count=5, speed_mps=0.5))
    assert creeping.chunk_travel_m == pytest.approx((0.2,)) and creeping.standstill_chunks == ()

    def tremble(frame: int, pose: np.ndarray) -> np.ndarray:
        moved = pose.copy()
        moved[0, 3] += 0.05 * (frame % 2)
        return moved

    trembling = check_log(with_ego(log_of(frame_count=20, speed_mps=0.0), tremble))
    assert trembling.travel_m > 0.9 and trembling.chunk_travel_m == pytest.approx((0.05,))
    assert "chunk 0: the ego vehicle stands still (0.05 m)" in messages(trembling, "warning")


@pytest.mark.parametrize("last_frames", [1, 4])
def test_a_last_chunk_that_is_not_reconstructed_does_not_stand_still(last_frames: int) -> None:
    driving = check_log(log_of(frame_count=5 + last_frames, speed_mps=20.0), chunk_frames=5)
    standing = check_log(log_of(frame_count=5 + last_frames, speed_mps=0.0), chunk_frames=5)
    assert "standstill" not in {finding.word for finding in driving.findings}
    assert [f.message[:7] for f in standing.findings if f.word == "standstill"] == ["chunk 0"]
    assert "the last chunk is short" in messages(driving, "note")


def test_a_chunk_whose_poses_cannot_be_read_does_not_stand_still() -> None:
    def lose(frame: int, pose: np.ndarray) -> np.ndarray:
        return pose if frame < 5 else np.full((4, 4), np.nan)

    check = check_log(with_ego(log_of(frame_count=10, speed_mps=20.0), lose, rig=False), chunk_frames=5)
    assert check.chunk_travel_m[0] == pytest.approx(8.0) and np.isnan(check.chunk_travel_m[1])
    words = {finding.word for finding in check.findings}
    assert "lost_chunk" in words and "standstill" not in words


def test_the_most_severe_finding_of_a_thing_stays_and_two_of_one_chunk_both_do(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    by_chunk = (
        [Finding("odd_box_heading", "note", "backwards")],
        [Finding("odd_box_heading", "warning", "sideways"), Finding("time_gap", "warning", "a gap")],
        [Finding("odd_box_heading", "note", "backwards again")],
    )

    def assess(log: object, frames: tuple[int, ...], cameras: object) -> list[Finding]:
        return by_chunk[frames[0] // 5]

    monkeypatch.setattr("genre_tasks.log_checks.check_log.assess_plausibility", assess)
    findings = check_log(log_of(frame_count=15, speed_mps=20.0), chunk_frames=5).findings
    assert [(finding.word, finding.severity, finding.message) for finding in findings] == [
        ("odd_box_heading", "warning", "sideways (chunks 1)"),
        ("time_gap", "warning", "a gap (chunks 1)"),
    ]


def test_readout_and_exposure_in_milliseconds_are_two_findings() -> None:
    log = log_of(frame_count=10, speed_mps=20.0, camera_names=("front",))
    odd = EditedLog(log, cameras=(Camera("front", log.lens, readout_s=30.0, exposure_s=8.0),))
    warnings = [finding.message for finding in check_log(odd, chunk_frames=5).findings if finding.camera == "front"]
    assert [message.split(" is ")[0] for message in warnings] == ["front: readout_s", "front: exposure_s"]
    assert all(message.endswith(" (chunks 0–1)") for message in warnings)


@pytest.mark.parametrize(
    ("times", "said"),
    [
        ((0.0, 0.1, 0.1, 0.2), "duplicated timestamps at frames 2"),
        ((0.0, 0.2, 0.1, 0.3), "time runs backwards at frames 2"),
        ((0.0, 100000.0, 200000.0, 300000.0), "the time between frames is 100000 s"),
        ((0.0, float("nan"), 0.2, 0.3), "frames 1 have no finite timestamp"),
    ],
)
def test_clocks(times: tuple[float, ...], said: str) -> None:
    check = check_log(log_of(timestamps_s=times, speed_mps=20.0), source_every=1)
    assert said in messages(check, "warning") and check.verdict == "usable"


def test_progress_covers_images_and_sweeps() -> None:
    calls: list[tuple[int, int]] = []
    check_log(log_of(), progress=lambda done, total, note="": calls.append((done, total)))
    assert [done for done, _ in calls] == list(range(1, 13)) and {total for _, total in calls} == {12}


class TestPandaSet:
    @pytest.fixture
    def folder(self, tmp_path: Path) -> Path:
        return write_pandaset(log_of(speed_mps=20.0), tmp_path / "002")

    def test_left_out_boxes_are_counted(self, folder: Path) -> None:
        edit_table(folder / "annotations/cuboids/01.pkl.gz", yaw=np.array([0.0, np.nan]))
        check = check_log(open_pandaset(str(folder)), source_every=1)
        assert check.invalid == (("invalid_box", 1),) and check.verdict == "usable"
        assert "is not finite" in messages(check, "warning")

    def test_a_bad_pose_is_a_finding(self, folder: Path) -> None:
        edit_json(folder / "lidar/poses.json", lambda poses: poses[2]["position"].update(x=float("nan")))
        check = check_log(open_pandaset(str(folder)))
        assert "the pose is not finite" in messages(check, "warning") and "frame 2" in messages(check, "warning")
        assert np.isfinite(check.travel_m)

    def test_a_camera_that_cannot_be_opened_is_fatal(self, folder: Path) -> None:
        edit_json(folder / "camera/left/poses.json", lambda poses: poses[:-1])
        check = check_log(open_pandaset(str(folder)))
        assert check.verdict == "unusable"
        assert "camera/left/poses.json" in messages(check, "fatal")

    def test_bad_intrinsics_are_fatal(self, folder: Path) -> None:
        (folder / "camera/left/intrinsics.json").write_text(json.dumps({"fx": 1}))
        check = check_log(open_pandaset(str(folder)))
        assert check.verdict == "unusable" and "fx, fy, cx, cy" in messages(check, "fatal")

    def test_cuboids_that_cannot_be_read_are_a_finding(self, folder: Path) -> None:
        (folder / "annotations/cuboids/01.pkl.gz").write_bytes(b"text")
        check = check_log(open_pandaset(str(folder)))
        assert messages(check, "warning").count("no readable pickle") == 1
        assert (check.tracks_moving, check.tracks_static) == (1, 1)
        for path in (folder / "annotations/cuboids").iterdir():
            path.write_bytes(b"text")
        check = check_log(open_pandaset(str(folder)))
        assert messages(check, "warning").count("no readable pickle") == 1
        assert check.tracks_moving == check.tracks_static == 0


@pytest.mark.real
@pytest.mark.skipif(not REAL.is_dir(), reason=f"no PandaSet sequence beside the checkout ({REAL})")
def test_the_real_sequence() -> None:
    check = check_log(open_log(f"pandaset:{REAL}"))
    assert check.frames == 32 and check.missing_sweeps == (28, 29, 30) and check.unreadable_sweeps == ()
    assert [round(travel, 1) for travel in check.chunk_travel_m] == [5.0, 5.2]
    assert all(camera == replace(camera, missing=(), unreadable=(), odd_size=()) for camera in check.cameras)
    assert {(camera.width_px, camera.height_px) for camera in check.cameras} == {(1920, 1080)}
    assert (check.tracks_moving, check.tracks_static) == (32, 63)
    assert check.verdict == "usable"
