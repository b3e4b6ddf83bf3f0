"""Images, JSON and times as people have them: read by rule, or refused with file and entry."""

from __future__ import annotations

import gzip
import json
import pickle
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from genre_tasks.errors import InputError
from genre_tasks.logs.pandaset.layout import parse_pose
from tests.logs.pandaset_folder import FRAMES, edit_json, findings, opened
from tests.ordinary_user import as_ordinary_user

START = 1557179160.5
ISO = [f"2019-05-06T21:46:0{k}.5" for k in range(FRAMES)]


def edit_frame(path: Path, change: Callable[[Any], Any]) -> None:
    """Replaces the DataFrame of a file by ``change(frame)``."""
    frame = pickle.loads(gzip.decompress(path.read_bytes()))
    path.write_bytes(gzip.compress(pickle.dumps(change(frame))))


def resize(path: Path, width: int, height: int) -> None:
    Image.open(path).resize((width, height)).save(path)


class TestImageSizes:
    @pytest.mark.parametrize("frame", range(FRAMES))
    @pytest.mark.parametrize("size", [(12, 8), (200, 100), (32, 48)])
    def test_the_odd_one_is_named_and_does_not_define_the_lens(
        self, folder: Path, frame: int, size: tuple[int, int]
    ) -> None:
        """Report: nerfstudio-project/nerfstudio#3232 (images of varying size)."""
        resize(folder / f"camera/left/{frame:02d}.png", *size)
        log = opened(folder)
        assert {(c.lens.width_px, c.lens.height_px) for c in log.cameras} == {(48, 32)}
        found = findings(log)["odd_image_size"]
        assert (found.frames, found.camera, found.severity) == ((frame,), "left", "warning")
        assert "48×32" in found.message

    def test_of_as_many_the_larger_ones_count(self, folder: Path) -> None:
        for frame in (0, 1):
            resize(folder / f"camera/left/{frame:02d}.png", 12, 8)
        assert opened(folder).cameras[1].lens.width_px == 48

    def test_a_stated_size_of_the_same_shape_scales_the_lens(self, folder: Path) -> None:
        """Report: graphdeco-inria/gaussian-splatting#692 (images at half the size of the intrinsics)."""
        expected = opened(folder).cameras[1].lens
        edit_json(folder / "camera/left/intrinsics.json", lambda v: v | {"width": 48, "height": 32})
        for path in folder.glob("camera/left/*.png"):
            resize(path, 24, 16)
        log = opened(folder)
        assert log.cameras[1].lens == expected.resized(24, 16)
        assert findings(log)["resampled_images"].severity == "note" and "odd_image_size" not in findings(log)

    def test_a_stated_size_of_another_shape_blames_the_images(self, folder: Path) -> None:
        edit_json(folder / "camera/left/intrinsics.json", lambda v: v | {"width": 48, "height": 40})
        log = opened(folder)
        assert (log.cameras[1].lens.width_px, log.cameras[1].lens.height_px) == (48, 40)
        assert findings(log)["odd_image_size"].frames == tuple(range(FRAMES))

    @pytest.mark.parametrize("size", [0, -5, float("nan"), float("inf"), "wide", None, True])
    def test_a_size_that_is_none(self, folder: Path, size: Any) -> None:
        edit_json(folder / "camera/left/intrinsics.json", lambda v: v | {"width": size})
        with pytest.raises(InputError) as caught:
            _ = opened(folder).cameras
        assert caught.value.file == str(folder / "camera/left/intrinsics.json")

    @pytest.mark.parametrize(
        ("data", "words"),
        [
            (
                b"version https://git-lfs.github.com/spec/v1\noid sha256:0\nsize 1\n",
                "a Git LFS pointer; run git lfs pull",
            ),
            (b"<html><body>Sign in</body></html>", "a web page"),
            (b"", "empty"),
            (b"\x89PNG\r\n\x1a\n\0\0", "no image"),
            (b"P6\n99999999999999999999 1\n255\n", "image"),
        ],
    )
    def test_files_that_are_no_images(self, folder: Path, data: bytes, words: str) -> None:
        """Report: jinnovation/rainy-image-dataset#2 (Git LFS pointers in place of images)."""
        (folder / "camera/left/01.png").write_bytes(data)
        log = opened(folder)
        found = findings(log)["unreadable_image"]
        assert words in found.message and found.frames == (1,) and len(log.cameras) == 2
        for path in folder.glob("camera/left/*.png"):
            path.write_bytes(data)
        log = opened(folder)
        assert words in findings(log)["camera_without_images"].message and len(log.cameras) == 1


class TestUnreadable:
    @pytest.mark.parametrize("name", ["camera/left/01.png", "lidar/01.pkl.gz", "camera/left/poses.json"])
    def test_an_error_of_the_system_names_file_and_reason(self, folder: Path, name: str) -> None:
        """Report: nerfstudio-project/nerfstudio#1130 (permissions of a data folder)."""
        reason = "Input/output error"
        (folder / name).unlink()
        # A file that opens and cannot be read, also by the superuser.
        (folder / name).symlink_to("/proc/self/mem")
        log = opened(folder)
        read: dict[str, Callable[[], object]] = {
            "camera/left/01.png": lambda: log.image_bytes("left", 1),
            "lidar/01.pkl.gz": lambda: log.sweep(1),
            "camera/left/poses.json": lambda: log.world_SE3_camera("left", 0),
        }
        with pytest.raises(InputError, match=reason) as caught:
            read[name]()
        assert caught.value.file == str(folder / name) and caught.value.remedy
        assert log.findings() is not None
        assert opened(folder).digest() == log.digest()

    def test_unreadable_cuboids_cost_their_frame(self, folder: Path) -> None:
        path = folder / "annotations/cuboids/01.pkl.gz"
        path.write_bytes(b"version https://git-lfs.github.com/spec/v1\n")
        log = opened(folder)
        assert log.tracks() and all(1 not in track.frames for track in log.tracks())
        found = findings(log)["unreadable_cuboids"]
        assert found.frames == (1,) and "Git LFS pointer" in found.message

    def test_permissions(self, folder: Path) -> None:
        assert opened(folder).image_bytes("left", 1)
        with as_ordinary_user(folder) as copy:
            (copy / "camera/left/01.png").chmod(0)
            with pytest.raises(InputError, match="Permission denied"):
                opened(copy).image_bytes("left", 1)


ODD_VALUES = [None, True, "text", "", [], {}, [[1.0]], {"a": 1}, 10**400]


class TestJson:
    @pytest.mark.parametrize("value", ODD_VALUES)
    @pytest.mark.parametrize("name", ["lidar/timestamps.json", "camera/left/timestamps.json"])
    def test_a_time_that_is_none(self, folder: Path, name: str, value: Any) -> None:
        """Report: kinverarity1/lasio#91 (ValueError on dates)."""
        edit_json(folder / name, lambda times: [*times[:2], value, *times[3:]])
        with pytest.raises(InputError) as caught:
            opened(folder).camera_timestamp_s("left", 0)
        assert (caught.value.file, caught.value.frame) == (str(folder / name), 2)
        assert "entry 2" in caught.value.problem and caught.value.remedy

    @pytest.mark.parametrize("value", [*ODD_VALUES, {"position": [1, 2, 3], "heading": [1, 0, 0, 0]}])
    def test_a_pose_that_is_none(self, folder: Path, value: Any) -> None:
        edit_json(folder / "camera/left/poses.json", lambda poses: [*poses[:2], value, *poses[3:]])
        log = opened(folder)
        with pytest.raises(InputError) as caught:
            log.world_SE3_camera("left", 2)
        assert (caught.value.frame, caught.value.camera) == (2, "left")
        assert log.world_SE3_camera("left", 1).shape == (4, 4)

    @pytest.mark.parametrize("number", [None, True, "x", [], 10**400, float("inf")])
    @pytest.mark.parametrize("key", ["fx", "cy"])
    def test_intrinsics_that_are_none(self, folder: Path, key: str, number: Any) -> None:
        edit_json(folder / "camera/left/intrinsics.json", lambda v: v | {key: number})
        with pytest.raises(InputError) as caught:
            _ = opened(folder).cameras
        assert caught.value.camera == "left"

    @pytest.mark.parametrize("value", [value for value in ODD_VALUES if value != [[1.0]]])
    @pytest.mark.parametrize("name", ["lidar/poses.json", "lidar/timestamps.json", "camera/left/poses.json"])
    def test_a_file_without_a_list(self, folder: Path, name: str, value: Any) -> None:
        (folder / name).write_text(json.dumps(value))
        with pytest.raises(InputError) as caught:
            opened(folder).world_SE3_camera("left", 0)
        assert caught.value.file == str(folder / name)

    @pytest.mark.parametrize("data", [b"[" * 100_000, b"\xff\xfe\xff", b"", b"<html>", bytes(100)])
    def test_bytes_that_are_no_json(self, folder: Path, data: bytes) -> None:
        (folder / "lidar/poses.json").write_bytes(data)
        with pytest.raises(InputError, match="JSON"):
            opened(folder)

    @pytest.mark.parametrize("encoding", ["utf-8-sig", "utf-16"])
    def test_encodings_of_windows(self, folder: Path, encoding: str) -> None:
        text = (folder / "lidar/poses.json").read_text()
        (folder / "lidar/poses.json").write_text(text, encoding=encoding)
        assert opened(folder).frame_count == FRAMES

    def test_one_broken_camera_leaves_the_others(self, folder: Path) -> None:
        (folder / "camera/left/timestamps.json").unlink()
        log = opened(folder)
        assert log.image_bytes("front", 0)
        with pytest.raises(InputError, match=r"left/timestamps\.json"):
            log.image_bytes("left", 0)

    def test_findings_never_raise(self, folder: Path) -> None:
        (folder / "camera/left/intrinsics.json").write_text("[]")
        for path in folder.glob("annotations/cuboids/*"):
            path.write_bytes(b"")
        assert opened(folder).findings() == ()


class TestTimes:
    @pytest.mark.parametrize(
        "times",
        [
            ISO,
            [f"{time}Z" for time in ISO],
            [f"{time}+00:00" for time in ISO],
            [time.replace("T", " ") + "00000" for time in ISO],
            [str(START + k) for k in range(FRAMES)],
            [f" {(START + k) * 1e6:.0f} " for k in range(FRAMES)],
        ],
    )
    def test_text(self, folder: Path, times: list[str]) -> None:
        """Report: gwpy/gwpy#658 (times stored as text)."""
        (folder / "lidar/timestamps.json").write_text(json.dumps(times))
        log = opened(folder)
        found = [log.frame_timestamp_s(frame) for frame in range(FRAMES)]
        np.testing.assert_allclose(found, [START + k for k in range(FRAMES)], rtol=0, atol=1e-6)

    @pytest.mark.parametrize("other", [START, str(START), "2019-05-06T21:46:02.5Z"])
    def test_mixed_kinds_are_refused(self, folder: Path, other: Any) -> None:
        """Report: none found; case 17 of the list of odd logs."""
        (folder / "lidar/timestamps.json").write_text(json.dumps([*ISO[:2], other, ISO[3]]))
        with pytest.raises(InputError, match=r"entry 2 is .*, but entry 0 is a date without a time zone"):
            opened(folder)

    def test_old_dates_keep_their_unit(self, folder: Path) -> None:
        """The unit of a date is known: its magnitude must not be asked."""
        (folder / "lidar/timestamps.json").write_text(json.dumps([f"9999-01-01T00:00:0{k}" for k in range(FRAMES)]))
        assert np.diff([opened(folder).frame_timestamp_s(frame) for frame in (0, 1)]) == 1.0


@pytest.mark.parametrize(
    ("pose", "part"),
    [
        (None, "found null"),
        ([1.0], "found a list of 1 entries"),
        ({"translation": 1}, "found the keys translation"),
        ({"position": [1, 2, 3], "heading": [1, 0, 0, 0]}, "position a list of 3 entries"),
        ({"position": {"x": None, "y": 1, "z": 1}, "heading": {"w": 1}}, "x = null"),
    ],
)
def test_what_is_no_pose_is_named(pose: object, part: str) -> None:
    """Report: none found; case 17 of the list of odd logs."""
    with pytest.raises(InputError, match=part) as caught:
        parse_pose(pose, file=Path("poses.json"), log="log", frame=3)
    assert caught.value.frame == 3 and "the pose lacks position x, y, z or heading w, x, y, z" in caught.value.problem
