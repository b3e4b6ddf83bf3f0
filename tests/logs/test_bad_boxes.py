"""One bad box among sound ones is left out in every reader, named, and met by no chunk but its own."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from pyarrow import feather

from genre_tasks.config import IngestConfig
from genre_tasks.errors import InputError
from genre_tasks.log_checks.check_log import check_log
from genre_tasks.logs.box_validity import find_bad_boxes
from genre_tasks.logs.findings import Finding
from genre_tasks.logs.genre_layout.writer import write_genre_layout
from genre_tasks.logs.pandaset.pickle_reader import read_table
from genre_tasks.logs.pandaset.writer import write_pandaset
from genre_tasks.logs.registry import open_log
from genre_tasks.logs.types import DrivingLog
from genre_tasks.stages.ingest import ingest
from tests.fakes import FakeLog
from tests.logs.argoverse2_folder import write_argoverse2
from tests.logs.kitti_folder import DRIVE, write_kitti, write_tracking_labels
from tests.logs.nuscenes_folder import VERSION, write_nuscenes
from tests.logs.pandaset_folder import edit_table
from tests.logs.waymo_folder import COMPONENTS, SEGMENT, write_waymo

FAKE = FakeLog(frame_count=6, camera_names=("front",), lidar_azimuths=90, lidar_rings=12, width_px=48, height_px=32)
# Of the moving car, which comes first in all files.
BAD_FRAME = 1
NAN, INF = float("nan"), float("inf")
# Centre, length and first number of the direction: what each fault puts there; None leaves a number as it is.
FAULTS: dict[str, tuple[Any, Any, Any]] = {
    "not finite": (NAN, None, None),
    "no size": (None, 0.0, None),
    "negative size": (None, -2.0, None),
    "no direction": (None, None, NAN),
    "far away": (-1e12, None, None),
}
PROBLEMS = {
    "not finite": "is not finite",
    "no size": "has a size that is not positive",
    "negative size": "has a size that is not positive",
    "no direction": "is not finite",
    "far away": "has a number beyond 1e+09",
}


@dataclass(frozen=True)
class Layout:
    """How a log is written in a reader's layout, and how its boxes are damaged.

    ``damage`` takes the folder, the new centre, length and direction, and the rows; ``None`` stands for all rows.
    """

    write: Callable[[Path], object]
    address: str
    file: str
    damage: Callable[[Path, tuple[Any, Any, Any], list[int] | None], None]


def _edit_columns(columns: dict[str, list[Any]], names: tuple[str, ...], values: Any, rows: list[int] | None) -> None:
    for name, value in zip(names, values, strict=True):
        for row in range(len(columns[name])) if rows is None else rows:
            if value is not None:
                columns[name][row] = value


def _damage_table(path: Path, names: tuple[str, ...], values: Any, rows: list[int] | None) -> None:
    is_feather = path.suffix == ".feather"
    table = feather.read_table(path) if is_feather else pq.read_table(path)
    columns = table.to_pydict()
    _edit_columns(columns, names, values, rows)
    (feather.write_feather if is_feather else pq.write_table)(pa.table(columns, schema=table.schema), path)


def _damage_waymo(root: Path, values: Any, rows: list[int] | None) -> None:
    names = tuple(f"[{COMPONENTS['lidar_box']}].{name}" for name in ("box.center.x", "box.size.x", "box.heading"))
    _damage_table(root / f"lidar_box/{SEGMENT}.parquet", names, values, rows)


def _damage_nuscenes(root: Path, values: Any, rows: list[int] | None) -> None:
    path = root / VERSION / "sample_annotation.json"
    boxes = json.loads(path.read_text())
    for box in boxes if rows is None else [boxes[row] for row in rows]:
        for name, index, value in zip(("translation", "size", "rotation"), (0, 1, 0), values, strict=True):
            if value is not None:
                box[name][index] = value
    path.write_text(json.dumps(boxes))


def _damage_tracklets(root: Path, values: Any, rows: list[int] | None) -> None:
    path = root / DRIVE / "tracklet_labels.xml"
    text = path.read_text()
    # A size is of all poses of a tracklet.
    for name, value in zip(("tx", "l", "rz"), values, strict=True):
        parts = text.split(f"<{name}>")
        chosen = [1] if name == "l" else [row + 1 for row in rows or ()]
        for part in range(1, len(parts)) if rows is None else chosen:
            if value is not None:
                parts[part] = f"{value}</{name}>" + parts[part].partition(f"</{name}>")[2]
        text = f"<{name}>".join(parts)
    path.write_text(text)


def _damage_labels(root: Path, values: Any, rows: list[int] | None) -> None:
    lines = (root / "labels.txt").read_text().splitlines()
    # The first line is a region that is not labelled.
    for number in range(1, len(lines)) if rows is None else [row + 1 for row in rows]:
        words = lines[number].split()
        for index, value in zip((13, 12, 16), values, strict=True):
            words[index] = words[index] if value is None else str(value)
        lines[number] = " ".join(words)
    (root / "labels.txt").write_text("\n".join(lines) + "\n")


def _damage_pandaset(root: Path, values: Any, rows: list[int] | None) -> None:
    for frame in [BAD_FRAME] if rows is not None else range(FAKE.frame_count):
        path = root / f"annotations/cuboids/{frame:02d}.pkl.gz"
        names = ("position.x", "dimensions.y", "yaw")
        columns = {name: read_table(path).columns[name].tolist() for name in names}
        _edit_columns(columns, names, values, None if rows is None else [0])
        edit_table(path, **{name: np.array(column) for name, column in columns.items()})


def _write_kitti_with_labels(root: Path) -> None:
    write_kitti(FAKE, root)
    write_tracking_labels(FAKE, root / "labels.txt")


LAYOUTS = {
    "argoverse2": Layout(
        lambda root: write_argoverse2(FAKE, root),
        "argoverse2:{}",
        "annotations.feather, row 1",
        lambda root, values, rows: _damage_table(
            root / "annotations.feather", ("tx_m", "length_m", "qw"), values, rows
        ),
    ),
    "waymo": Layout(
        lambda root: write_waymo(FAKE, root), f"waymo:{{}}/{SEGMENT}", f"lidar_box/{SEGMENT}.parquet", _damage_waymo
    ),
    "nuscenes": Layout(
        lambda root: write_nuscenes(FAKE, root), "nuscenes:{}/scene-0061", "sample_annotation.json", _damage_nuscenes
    ),
    "kitti": Layout(
        lambda root: write_kitti(FAKE, root),
        f"kitti:{{}}/{DRIVE}",
        "tracklet_labels.xml, pose 1 of tracklet 0",
        _damage_tracklets,
    ),
    "kitti labels": Layout(
        _write_kitti_with_labels, f"kitti:{{0}}/{DRIVE}?labels={{0}}/labels.txt", "labels.txt, line 3", _damage_labels
    ),
    "pandaset": Layout(lambda root: write_pandaset(FAKE, root), "pandaset:{}", "cuboids/01.pkl.gz", _damage_pandaset),
    "genre": Layout(
        lambda root: write_genre_layout(FAKE, root),
        "genre:{}",
        "boxes.parquet, row 1",
        lambda root, values, rows: _damage_table(root / "boxes.parquet", ("x", "length", "qw"), values, rows),
    ),
}


@pytest.fixture(scope="module")
def written(tmp_path_factory: pytest.TempPathFactory) -> Callable[[str], Path]:
    roots: dict[str, Path] = {}

    def write(name: str) -> Path:
        if name not in roots:
            roots[name] = tmp_path_factory.mktemp("bad_boxes") / "log"
            LAYOUTS[name].write(roots[name])
        return roots[name]

    return write


def _open_damaged(name: str, source: Path, root: Path, values: Any, rows: list[int] | None) -> DrivingLog:
    shutil.copytree(source, root)
    LAYOUTS[name].damage(root, values, rows)
    return open_log(LAYOUTS[name].address.format(root))


def _find_invalid(findings: Any) -> list[Finding]:
    return [finding for finding in findings if finding.word == "invalid_box"]


@pytest.mark.parametrize("fault", FAULTS)
@pytest.mark.parametrize("name", LAYOUTS)
def test_a_bad_box_is_left_out_alone_and_named(
    written: Callable[[str], Path], tmp_path: Path, name: str, fault: str
) -> None:
    known = open_log(LAYOUTS[name].address.format(written(name))).tracks()
    mover, *others = sorted(known, key=lambda track: not track.moving)
    log = _open_damaged(name, written(name), tmp_path / "log", FAULTS[fault], [1])
    tracks = {track.track_id: track for track in log.tracks()}
    # A tracklet has one size for all frames.
    is_lost = name == "kitti" and "size" in fault
    for track in others if is_lost else (mover, *others):
        found = tracks.pop(track.track_id)
        is_left = track.frames != BAD_FRAME
        # Sound boxes of the key frames before and after stand for that of a key frame.
        if track is not mover or name == "nuscenes":
            is_left[:] = True
        np.testing.assert_array_equal(found.frames, track.frames[is_left])
        np.testing.assert_allclose(found.world_SE3_box, track.world_SE3_box[is_left], atol=1e-6)
        np.testing.assert_allclose(found.size_m, track.size_m)
    assert not tracks
    invalid = _find_invalid(log.findings())  # type: ignore[attr-defined]
    frames = range(FAKE.frame_count) if is_lost else [BAD_FRAME]
    assert [finding.frames for finding in invalid] == [(frame,) for frame in frames]
    (finding,) = (finding for finding in invalid if finding.frames == (BAD_FRAME,))
    assert finding.severity == "warning" and "left out" in finding.remedy
    assert finding.message.endswith(PROBLEMS[fault])
    for part in (mover.label, f"{mover.track_id} in frame {BAD_FRAME}", LAYOUTS[name].file):
        assert part in finding.message
    (merged,) = _find_invalid(check_log(log, source_every=1).findings)
    assert merged.message.startswith(invalid[0].message)


@pytest.mark.parametrize("name", LAYOUTS)
def test_other_chunks_do_not_meet_it(written: Callable[[str], Path], tmp_path: Path, name: str) -> None:
    log = _open_damaged(name, written(name), tmp_path / "log", FAULTS["not finite"], [1])
    config = IngestConfig(width_px=48, height_px=32, chunk_frames=3, source_every=1, min_actor_frames=1)
    found = [ingest(config, log, chunk) for chunk in (0, 1)]
    issues = [[issue for issue in chunk.log_issues if issue.kind == "invalid_box"] for chunk in found]
    assert [issue.frame for issue in issues[0]] == [BAD_FRAME] and not issues[1]
    assert LAYOUTS[name].file in issues[0][0].detail and "Correct the box" in issues[0][0].detail
    # The moving car is an actor in both.
    assert [len(chunk.actors) for chunk in found] == [1, 1]
    strict = config.model_copy(update={"strict": True})
    # Opened again: what reading a chunk reports must not depend on what was read before.
    log = open_log(log.uri)
    with pytest.raises(InputError, match=r"the box of .* is not finite") as caught:
        ingest(strict, log, 0)
    assert (caught.value.chunk, caught.value.frame) == (0, BAD_FRAME)
    assert len(ingest(strict, log, 1).actors) == 1


@pytest.mark.parametrize("name", LAYOUTS)
def test_a_log_whose_boxes_are_all_bad_is_refused(written: Callable[[str], Path], tmp_path: Path, name: str) -> None:
    log = _open_damaged(name, written(name), tmp_path / "log", FAULTS["no size"], None)
    with pytest.raises(InputError, match=r"all 12 boxes are bad: the first one .frame 0; .* not positive") as caught:
        log.tracks()
    assert caught.value.file is not None and caught.value.remedy


@pytest.mark.parametrize("change", ["a null", "a quaternion of zeros", "a large whole number"])
def test_boxes_of_other_scenes_do_not_matter(written: Callable[[str], Path], tmp_path: Path, change: str) -> None:
    """All scenes of nuScenes share a table; a bad number of one must not take the others with it."""
    root = tmp_path / "log"
    shutil.copytree(written("nuscenes"), root)
    path = root / VERSION / "sample_annotation.json"
    boxes = json.loads(path.read_text())
    column, value = {
        "a null": ("translation", [None, 0.0, 0.0]),
        "a quaternion of zeros": ("rotation", [0, 0, 0, 0]),
        "a large whole number": ("size", [10**400, 1, 1]),
    }[change]
    boxes.append({**boxes[0], "token": "0" * 32, "sample_token": "elsewhere", column: value})
    path.write_text(json.dumps(boxes))
    log = open_log(f"nuscenes:{root}/scene-0061")
    assert [len(track.frames) for track in log.tracks()] == [6, 6]
    assert not _find_invalid(log.findings())  # type: ignore[attr-defined]


def test_frames_that_rest_on_a_bad_box_are_named(tmp_path: Path) -> None:
    """Of key frames 0, 3 and 6 the middle one is bad: frames 1 to 5 get other boxes."""
    fake = FAKE.with_(frame_count=7)
    write_nuscenes(fake, tmp_path, key_every=3)
    _damage_nuscenes(tmp_path, (INF, None, None), [1])
    log = open_log(f"nuscenes:{tmp_path}/scene-0061")
    (mover,) = (track for track in log.tracks() if track.moving)
    (finding,) = _find_invalid(log.findings())  # type: ignore[attr-defined]
    assert finding.frames == (1, 2, 3, 4, 5) and "in frame 3 " in finding.message
    assert mover.frames.tolist() == list(range(7))


def test_what_makes_a_box_bad() -> None:
    centres, sizes = np.zeros((4, 3)), np.ones((4, 3))
    quats = np.array([[1.0, 0, 0, 0], [0, 0, 0, 0], [1e-9, 0, 0, 0], [0, 0, 2.0, 0]])
    assert find_bad_boxes(centres, sizes, quats=quats) == dict.fromkeys((1, 2), "has a quaternion of zeros")
    angles = np.array([[0.0], [NAN], [INF], [7.0]])
    assert find_bad_boxes(centres, sizes, angles_rad=angles) == dict.fromkeys((1, 2), "is not finite")
    assert find_bad_boxes(centres[:0], sizes[:0], quats=quats[:0]) == {}
