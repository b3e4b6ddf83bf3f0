"""Sequences on disk whose images, intrinsics or poses do not fit: check and run say the same."""

from __future__ import annotations

import io
import json
import re
from collections.abc import Callable
from pathlib import Path

import pytest
from PIL import Image

from genre_tasks.config import IngestConfig
from genre_tasks.errors import InputError
from genre_tasks.log_checks.check_log import check_log
from genre_tasks.log_checks.results import LogCheck
from genre_tasks.logs.pandaset.pickle_reader import read_table
from genre_tasks.logs.pandaset.reader import open_pandaset
from genre_tasks.logs.pandaset.writer import write_pandaset
from genre_tasks.stages.ingest import ingest
from tests.log_checks.edited_log import street
from tests.logs.pandaset_folder import edit_json, edit_table

CONFIG = IngestConfig(width_px=48, height_px=32)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    return write_pandaset(street(), tmp_path / "002")


def check(folder: Path) -> LogCheck:
    return check_log(open_pandaset(str(folder)), chunk_frames=8)


def words(found: LogCheck) -> set[str]:
    return {finding.word for finding in found.findings}


def run_words(folder: Path) -> set[str]:
    return {issue.kind for issue in ingest(CONFIG, open_pandaset(str(folder)), 0).log_issues}


def drop_size(intrinsics: dict[str, float]) -> dict[str, float]:
    """As PandaSet's own files have them: nothing says which size of image they belong to."""
    return {key: number for key, number in intrinsics.items() if key not in ("width", "height")}


def test_a_sound_sequence(folder: Path) -> None:
    assert check(folder).verdict == "good" and run_words(folder) == set()


def test_images_halved(folder: Path) -> None:
    """Report: nv-tlabs/lift-splat-shoot#35."""
    for file in folder.glob("camera/*/intrinsics.json"):
        edit_json(file, drop_size)
    for file in folder.glob("camera/*/*.png"):
        image = Image.open(io.BytesIO(file.read_bytes()))
        image.resize((image.width // 2, image.height // 2), Image.Resampling.BOX).save(file)
    found = check(folder)
    assert found.verdict == "usable" and words(found) == run_words(folder) == {"odd_principal_point"}
    assert {finding.camera for finding in found.findings} == {"front", "left"}
    assert "look resized by 0.5" in found.findings[0].remedy


def test_strict_stops_at_halved_images(folder: Path) -> None:
    """Report: nv-tlabs/lift-splat-shoot#35."""
    file = folder / "camera/left/intrinsics.json"
    edit_json(file, lambda value: {key: 2 * number for key, number in drop_size(value).items()})
    with pytest.raises(InputError, match="principal point"):
        ingest(IngestConfig(width_px=48, height_px=32, strict=True), open_pandaset(str(folder)), 0)


@pytest.mark.parametrize("distortion", [[0.1, -0.05, 0.0, 0.0, 0.01, 0.1, 0.0, 0.0], [1e3], [-1e3], ["a"]])
def test_distortion_that_cannot_be_used(folder: Path, distortion: list[object]) -> None:
    """Report: koide3/direct_visual_lidar_calibration#69, opencv/opencv#14596."""
    file = folder / "camera/left/intrinsics.json"
    file.write_text(json.dumps({**json.loads(file.read_text()), "distortion": distortion}))
    found = check(folder)
    assert found.verdict == "unusable"
    assert any("intrinsics.json" in finding.message and finding.remedy for finding in found.findings)
    with pytest.raises(InputError, match="distortion"):
        ingest(CONFIG, open_pandaset(str(folder)), 0)


def add_distance(metres_per_frame: float) -> Callable[[list[dict[str, dict[str, float]]]], None]:
    def change(poses: list[dict[str, dict[str, float]]]) -> None:
        for frame, pose in enumerate(poses):
            pose["position"]["x"] += metres_per_frame * frame

    return change


def test_sixty_metres_a_frame(folder: Path) -> None:
    """Report: none found; case 6 of the list of odd logs."""
    for file in [folder / "lidar/poses.json", *folder.glob("camera/*/poses.json")]:
        edit_json(file, add_distance(60.0))
    for frame, file in enumerate(sorted(folder.glob("lidar/*.pkl.gz"))):
        edit_table(file, x=read_table(file).columns["x"] + 60.0 * frame)
    found = check(folder)
    assert "implausible_speed" in words(found) & run_words(folder) and found.verdict == "usable"


def test_cameras_that_stay_where_the_vehicle_was(folder: Path) -> None:
    """Report: lyft/nuscenes-devkit#73."""
    edit_json(folder / "camera/left/poses.json", lambda poses: [poses[0]] * len(poses))
    found = check(folder)
    assert words(found) == run_words(folder) == {"loose_camera"}
    assert [finding.camera for finding in found.findings] == ["left"]


Numbers = dict[str, float]


@pytest.mark.parametrize(
    ("change", "problem"),
    [
        (
            lambda v: {"K": [[v["fx"], 0, v["cx"]], [0, v["fy"], v["cy"]], [0, 0, 1]]},
            "lacks fx, fy, cx, cy; its keys are K",
        ),
        (lambda v: {key.upper(): number for key, number in v.items()}, "its keys are FX, FY, CX, CY"),
        (lambda v: list(v.values()), "found a list of"),
        (lambda v: {**v, "fx": None}, "null is no number"),
        (lambda v: {**v, "width": "48 px"}, "'48 px' is no number"),
        (lambda v: {**v, "readout_s": -0.03}, "readout_s is -0.03"),
        (lambda v: {**v, "exposure_s": float("nan")}, "exposure_s nan"),
        (lambda v: {**v, "skew": 50.0}, "skew = 50"),
    ],
)
def test_intrinsics_that_are_none(folder: Path, change: Callable[[Numbers], object], problem: str) -> None:
    """Report: none found; case 2 of the list of odd logs."""
    edit_json(folder / "camera/left/intrinsics.json", change)
    found = check(folder)
    assert found.verdict == "unusable"
    messages = [finding.message for finding in found.findings if finding.word == "unreadable_camera"]
    assert len(messages) == 1 and problem in messages[0] and "left/intrinsics.json" in messages[0]
    assert not any("Copy the camera folders" in finding.remedy for finding in found.findings)
    with pytest.raises(InputError, match=re.escape(problem)):
        ingest(CONFIG, open_pandaset(str(folder)), 0)


@pytest.mark.parametrize("name", ["readout_s", "exposure_s"])
def test_milliseconds_for_seconds(folder: Path, name: str) -> None:
    """Report: none found; case 2 of the list of odd logs."""
    edit_json(folder / "camera/left/intrinsics.json", lambda value: {**value, name: 30.0})
    found = check(folder)
    assert found.verdict == "usable" and words(found) == run_words(folder) == {"odd_shutter_time"}
    assert found.findings[0].camera == "left" and name in found.findings[0].message
