"""A log written in the PandaSet layout and read back is the same log."""

from __future__ import annotations

import io
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from genre_tasks.errors import InputError, ResourceError
from genre_tasks.logs.pandaset.reader import open_pandaset
from genre_tasks.logs.pandaset.writer import write_pandaset
from genre_tasks.logs.registry import open_log
from genre_tasks.logs.types import Camera, CuboidTrack, DrivingLog
from tests.fakes import FakeCar, FakeLog
from tests.log_checks.edited_log import EditedLog
from tests.logs.pandaset_folder import small_log


def assert_same_log(found: DrivingLog, expected: DrivingLog) -> None:
    """Cameras, times, poses to 1e-9, images byte for byte, points bit for bit, tracks."""
    assert found.frame_count == expected.frame_count
    assert [c.name for c in found.cameras] == [c.name for c in expected.cameras]
    for one, other in zip(found.cameras, expected.cameras, strict=True):
        assert one.exposure_s == other.exposure_s
        assert one.readout_s == other.readout_s and one.lens.distortion == other.lens.distortion
        np.testing.assert_allclose(
            [one.lens.fx_px, one.lens.fy_px, one.lens.cx_px, one.lens.cy_px, one.lens.width_px, one.lens.height_px],
            [
                other.lens.fx_px,
                other.lens.fy_px,
                other.lens.cx_px,
                other.lens.cy_px,
                other.lens.width_px,
                other.lens.height_px,
            ],
            rtol=0,
            atol=1e-9,
        )
    for frame in range(expected.frame_count):
        assert found.frame_timestamp_s(frame) == expected.frame_timestamp_s(frame)
        np.testing.assert_allclose(found.world_SE3_lidar(frame), expected.world_SE3_lidar(frame), rtol=0, atol=1e-9)
        for camera in expected.cameras:
            pose = expected.world_SE3_camera(camera.name, frame)
            np.testing.assert_allclose(found.world_SE3_camera(camera.name, frame), pose, rtol=0, atol=1e-9)
            assert found.camera_timestamp_s(camera.name, frame) == expected.camera_timestamp_s(camera.name, frame)
            assert found.image_bytes(camera.name, frame) == expected.image_bytes(camera.name, frame)
        one_sweep, other_sweep = found.sweep(frame), expected.sweep(frame)
        assert (one_sweep is None) == (other_sweep is None)
        if one_sweep is not None and other_sweep is not None:
            np.testing.assert_array_equal(one_sweep.points_world, other_sweep.points_world)
            np.testing.assert_array_equal(one_sweep.intensity, other_sweep.intensity)
            np.testing.assert_array_equal(one_sweep.timestamps_s, other_sweep.timestamps_s)
    assert_same_tracks(found.tracks(), expected.tracks())


def assert_same_tracks(found: tuple[CuboidTrack, ...], expected: tuple[CuboidTrack, ...]) -> None:
    by_id = {track.track_id: track for track in found}
    assert set(by_id) == {track.track_id for track in expected if len(track.frames)}
    for track in expected:
        one = by_id[track.track_id]
        np.testing.assert_array_equal(one.frames, track.frames)
        np.testing.assert_allclose(one.world_SE3_box, track.world_SE3_box, rtol=0, atol=1e-9)
        np.testing.assert_allclose(one.size_m, track.size_m, rtol=0, atol=1e-12)
        assert (one.label, one.moving) == (track.label, track.moving)


class TestRoundTrip:
    def test_fake_log(self, tmp_path: Path) -> None:
        turned = (FakeCar("a", 6.0, 3.0, 5.0, yaw_rad=2.7), FakeCar("b", 14.0, -4.0, yaw_rad=-3.1))
        log = small_log().with_(
            cars=turned,
            world_offset_m=(4e6, -5e5, 12.0),
            ego_yaw_rad=0.7,
            track_every=2,
            missing_images=frozenset({("left", 1)}),
            missing_sweeps=frozenset({2}),
            timestamps_s=(1557539959.300518, 1557539959.400481, 1557539959.500444, 1557539959.600418),
        )
        written = write_pandaset(log, tmp_path / "out" / "041")
        assert_same_log(open_pandaset(str(written)), log)

    def test_synthetic_street(self, tmp_path: Path) -> None:
        pytest.importorskip("embreex", reason="the synthetic street is ray-cast with Embree")
        log = open_log("synthetic:street?seed=1000&frames=3&cameras=6&width=64&height=36&samples=1")
        written = write_pandaset(log, tmp_path / "000")
        assert len(log.tracks()) > 0
        assert_same_log(open_log(f"pandaset:{written}"), log)

    def test_the_same_log_gives_the_same_bytes(self, tmp_path: Path) -> None:
        one, two = (write_pandaset(small_log(), tmp_path / name) for name in ("1", "2"))
        assert open_pandaset(str(one)).digest() == open_pandaset(str(two)).digest()

    def test_a_box_on_a_slope(self, tmp_path: Path) -> None:
        track = small_log().tracks()[0]
        tilted = track.world_SE3_box.copy()
        tilted[:, :3, :3] = tilted[:, :3, :3] @ np.array([[1, 0, 0], [0, 0.8, -0.6], [0, 0.6, 0.8]])
        log = small_log().with_(extra_tracks=(CuboidTrack("tilted", "Car", track.frames, tilted, track.size_m, False),))
        written = write_pandaset(log, tmp_path / "002")
        assert_same_tracks(open_pandaset(str(written)).tracks(), log.tracks())

    def test_jpeg_keeps_its_bytes(self, tmp_path: Path) -> None:
        stream = io.BytesIO()
        Image.new("RGB", (48, 32), (10, 200, 30)).save(stream, "JPEG")
        log = small_log()
        log._images[("front", 1)] = stream.getvalue()
        written = write_pandaset(log, tmp_path / "002")
        assert (written / "camera/front/01.jpg").read_bytes() == stream.getvalue()
        assert (written / "camera/front/00.png").is_file()
        assert open_pandaset(str(written)).image_bytes("front", 1) == stream.getvalue()

    @pytest.mark.parametrize(("kind", "suffix"), [("WEBP", ".webp"), ("TIFF", ".tif"), ("BMP", ".bmp")])
    def test_other_formats_keep_their_bytes(self, tmp_path: Path, kind: str, suffix: str) -> None:
        stream = io.BytesIO()
        Image.new("RGB", (48, 32), (10, 200, 30)).save(stream, kind)
        log = small_log()
        log._images[("front", 1)] = stream.getvalue()
        written = write_pandaset(log, tmp_path / "002")
        assert (written / f"camera/front/01{suffix}").read_bytes() == stream.getvalue()
        assert open_pandaset(str(written)).image_bytes("front", 1) == stream.getvalue()

    def test_the_size_of_the_intrinsics_survives_images_of_another_one(self, tmp_path: Path) -> None:
        """Most images of a camera are of another shape than its lens: they are left out before and after."""
        log = small_log()
        for frame in range(log.frame_count):
            stream = io.BytesIO()
            Image.new("RGB", (48, 24), (10, 200, 30)).save(stream, "PNG")
            log._images[("front", frame)] = stream.getvalue()
        found = open_pandaset(str(write_pandaset(log, tmp_path / "002")))
        assert {(c.lens.width_px, c.lens.height_px) for c in found.cameras} == {(48, 32)}
        assert {finding.word: finding.frames for finding in found.findings()} == {"odd_image_size": (0, 1, 2, 3)}

    def test_progress_ends_at_its_total(self, tmp_path: Path) -> None:
        calls: list[tuple[int, int]] = []
        write_pandaset(small_log(), tmp_path / "002", lambda done, total, note="": calls.append((done, total)))
        assert [done for done, _ in calls] == list(range(1, 13))
        assert {total for _, total in calls} == {12}


@pytest.mark.parametrize("name", ["../../x", "/home/u/x", "..", "a\\b", "a\0b", ""])
def test_a_name_that_is_no_folder_is_not_written(tmp_path: Path, name: str) -> None:
    log = EditedLog(small_log(), cameras=(Camera(name, small_log().lens),))
    with pytest.raises(InputError, match="cannot be a folder's name") as caught:
        write_pandaset(log, tmp_path / "logs/002")
    assert caught.value.remedy and list(tmp_path.iterdir()) == []


class TestAtomic:
    def test_a_folder_with_something_in_it_is_refused(self, tmp_path: Path) -> None:
        (tmp_path / "002").mkdir()
        (tmp_path / "002" / "mine.txt").write_text("keep")
        with pytest.raises(InputError, match="holds something"):
            write_pandaset(small_log(), tmp_path / "002")
        assert [p.name for p in (tmp_path / "002").iterdir()] == ["mine.txt"]

    def test_a_file_in_its_place_is_refused(self, tmp_path: Path) -> None:
        (tmp_path / "002").write_text("keep")
        with pytest.raises(InputError):
            write_pandaset(small_log(), tmp_path / "002")

    def test_an_empty_folder_is_used(self, tmp_path: Path) -> None:
        (tmp_path / "002").mkdir()
        assert (write_pandaset(small_log(), tmp_path / "002") / "lidar/poses.json").is_file()

    def test_a_failure_leaves_nothing(self, tmp_path: Path) -> None:
        broken: FakeLog = small_log().with_(unreadable_sweeps=frozenset({3}))
        with pytest.raises(InputError):
            write_pandaset(broken, tmp_path / "002")
        assert list(tmp_path.iterdir()) == []

    def test_an_image_of_another_kind(self, tmp_path: Path) -> None:
        log = small_log()
        log._images[("left", 2)] = b"GIF89a"
        with pytest.raises(InputError) as caught:
            write_pandaset(log, tmp_path / "002")
        assert (caught.value.camera, caught.value.frame) == ("left", 2)
        assert list(tmp_path.iterdir()) == []

    def test_a_full_disk(self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        def full(*_: object) -> None:
            raise OSError(28, "No space left on device")

        monkeypatch.setattr("genre_tasks.logs.pandaset.writer._write_lidar", full)
        with pytest.raises(ResourceError, match="No space left"):
            write_pandaset(small_log(), tmp_path / "002")
        assert list(tmp_path.iterdir()) == []
