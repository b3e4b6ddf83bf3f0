"""``genre check`` and ``ingest`` judge the images of a log alike, in the same words."""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np
import pytest
from PIL import Image

from genre_tasks.config import IngestConfig
from genre_tasks.errors import InputError
from genre_tasks.log_checks.check_log import check_log
from genre_tasks.logs.findings import Finding
from genre_tasks.stages.ingest import ingest
from tests.fakes import FakeLog
from tests.log_checks.edited_log import EditedLog, is_complete, street
from tests.logs.pandaset_folder import small_log
from tests.scene.encoded_images import encode, picture

CONFIG = IngestConfig(width_px=48, height_px=32, source_every=1, chunk_frames=4)
PICTURE = picture(32, 48)
GREY16 = PICTURE[..., 2].astype(np.uint16)


def log_with(images: Mapping[int, bytes]) -> FakeLog:
    """A log of four frames with other images of the camera ``front``."""
    log = small_log().with_(frame_count=4, speed_mps=20.0, lidar_azimuths=360)
    log._images.update({("front", frame): data for frame, data in images.items()})
    return log


def judge(log: FakeLog) -> tuple[dict[str, Finding], dict[str, list[str]], int]:
    """Findings of the check, details of a run's issues by word, and how many images of the camera the run used."""
    found = {f.word: f for f in check_log(log, chunk_frames=4).findings if f.camera == "front"}
    out = ingest(CONFIG, log, 0)
    issues: dict[str, list[str]] = {}
    for issue in out.log_issues:
        issues.setdefault(issue.kind, []).append(issue.detail)
    return found, issues, sum(view.camera == "front" for view in out.views)


def turned() -> bytes:
    exif = Image.Exif()
    exif[0x0112] = 6
    return encode(PICTURE, "JPEG", exif=exif)


@pytest.mark.parametrize(
    ("make", "word", "part"),
    [
        (turned, "unreadable_image", "orientation"),
        (lambda: b"version https://git-lfs.github.com/spec/v1\noid sha256:0\nsize 1\n", "unreadable_image", "LFS"),
        (lambda: encode(PICTURE)[:100], "unreadable_image", "truncated"),
        (lambda: encode(PICTURE, "WEBP")[:100], "unreadable_image", "cannot decode"),
        (lambda: encode(PICTURE[..., 0].astype(np.float32), "TIFF"), "unreadable_image", "range"),
        (lambda: encode(PICTURE[::4, ::4]), "odd_image_size", "12×8"),
        (lambda: encode(PICTURE[:-1]), "odd_image_size", "48×31"),
        (lambda: encode(np.zeros_like(PICTURE)), "blank_image", "one colour"),
        (lambda: encode(np.zeros((1, 1, 3), np.uint8)), "odd_image_size", "1×1"),
    ],
)
def test_what_a_run_leaves_out_is_a_finding_of_the_check(make: Callable[[], bytes], word: str, part: str) -> None:
    """Report: nerfstudio-project/nerfstudio#3585 (an image whose size is not that of its camera)."""
    found, issues, used = judge(log_with({2: make()}))
    assert found[word].frames == (2,) and found[word].severity == "warning" and part in found[word].message
    (detail,) = issues[word]
    assert used == 3 and detail.partition(". ")[0] in found[word].message
    with pytest.raises(InputError, match="frame 2"):
        ingest(CONFIG.model_copy(update={"strict": True}), log_with({2: make()}), 0)


@pytest.mark.parametrize(
    ("make", "word"),
    [
        (lambda: encode(GREY16 * 16), "narrow_range_16_bit"),
        (lambda: encode(np.dstack([PICTURE, PICTURE[..., :1]])), "transparent_image"),
        (lambda: encode(PICTURE, icc_profile=b"no profile"), "unconverted_colors"),
    ],
)
def test_what_is_in_doubt_is_one_issue_a_camera(make: Callable[[], bytes], word: str) -> None:
    found, issues, used = judge(log_with(dict.fromkeys(range(4), make())))
    assert found[word].frames == (0, 1, 2, 3) and used == 4
    assert issues[word] == [f"{found[word].message}. {found[word].remedy}"]
    with pytest.raises(InputError, match="frame 0"):
        ingest(CONFIG.model_copy(update={"strict": True}), log_with({0: make()}), 0)


def test_a_rule_that_loses_something_is_a_note() -> None:
    found, issues, used = judge(log_with(dict.fromkeys(range(4), encode(GREY16 * 257))))
    assert found["reduced_depth"].severity == "note" and issues == {} and used == 4
    # Images of a camera that moves differ.
    moving = {frame: encode(np.roll(GREY16 * 257, frame, axis=1)) for frame in range(4)}
    assert check_log(log_with(moving), source_every=1).verdict == "good"


def test_a_log_of_which_every_image_is_refused_is_unusable() -> None:
    log = log_with(dict.fromkeys(range(4), turned())).with_(camera_names=("front",))
    log._images.update({("front", frame): turned() for frame in range(4)})
    check = check_log(log)
    assert check.verdict == "unusable" and {f.word for f in check.findings} >= {"unreadable_image", "no_readable_image"}
    with pytest.raises(InputError, match=r"4 images are left out.*orientation is 6"):
        ingest(CONFIG, log, 0)


def test_a_file_that_the_reader_cannot_open_is_one_finding() -> None:
    """Report: none found; case 13 of the list of odd logs."""

    class Locked(FakeLog):
        def image_bytes(self, camera: str, frame: int) -> bytes | None:
            if (camera, frame) == ("front", 2):
                raise InputError("permission denied", remedy="Change its mode.", file="/data/002/camera/front/02.png")
            return super().image_bytes(camera, frame)

    found, issues, used = judge(Locked(frame_count=4, width_px=48, height_px=32, speed_mps=20.0, lidar_azimuths=360))
    assert "front: unreadable images at frames 2: permission denied (file 02.png)" in found["unreadable_image"].message
    assert issues["unreadable_image"] == ["permission denied (file 02.png). Change its mode."] and used == 3


@pytest.mark.parametrize(("speed_mps", "is_found"), [(10.0, True), (0.5, False), (0.0, False)])
def test_a_camera_that_hangs_while_the_vehicle_moves(speed_mps: float, is_found: bool) -> None:
    log = street(speed_mps=speed_mps)

    def image_bytes(camera: str, frame: int) -> bytes | None:
        return log.image_bytes(camera, 3 if camera == "front" and 3 < frame < 6 else frame)

    found = [f for f in check_log(EditedLog(log, image_bytes=image_bytes)).findings if f.word == "repeated_image"]
    assert [(f.camera, f.frames) for f in found] == ([("front", (3, 4, 5))] if is_found else [])
    assert all("front: the images of frames 3–5 repeat" in f.message and is_complete(f) for f in found)
