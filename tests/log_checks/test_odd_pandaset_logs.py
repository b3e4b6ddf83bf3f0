"""``genre check`` and the stage ``ingest`` judge odd PandaSet folders alike, and neither raises anything of its own."""

from __future__ import annotations

import os
import random
import shutil
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
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
from tests.fakes import FakeLog
from tests.logs.pandaset_folder import edit_json, edit_table

CONFIG = IngestConfig(width_px=48, height_px=32, source_every=2, complete_facades=False)
STRICT = CONFIG.model_copy(update={"strict": True})
POINTER = "version https://git-lfs.github.com/spec/v1\noid sha256:0\nsize 1\n"


@pytest.fixture(scope="module")
def written(tmp_path_factory: pytest.TempPathFactory) -> Path:
    log = FakeLog(frame_count=6, width_px=48, height_px=32, lidar_rings=16, lidar_azimuths=180, speed_mps=20.0)
    return write_pandaset(log, tmp_path_factory.mktemp("source") / "002")


@pytest.fixture
def folder(written: Path, tmp_path: Path) -> Path:
    shutil.copytree(written, tmp_path / "002")
    return tmp_path / "002"


def shrink_first(folder: Path) -> None:
    for path in folder.glob("camera/*/00.png"):
        Image.open(path).resize((12, 8)).save(path)


def turn_forward(folder: Path) -> None:
    for path in folder.glob("lidar/*.pkl.gz"):
        edit_table(path, d=np.ones(read_table(path).row_count, dtype=np.int64))


def break_pose(folder: Path) -> None:
    edit_json(folder / "camera/left/poses.json", lambda poses: poses[2]["position"].update(x=None))


def break_lidar_pose(folder: Path) -> None:
    edit_json(folder / "lidar/poses.json", lambda poses: poses[2].pop("heading") and None)


def link_to_unreadable(path: Path) -> None:
    path.unlink()
    path.symlink_to("/proc/self/mem")


def count_from_one(folder: Path) -> None:
    for path in sorted(folder.glob("camera/left/*.png"), reverse=True):
        path.rename(path.with_name(f"{int(path.stem) + 1:02d}.png"))


@dataclass(frozen=True)
class Case:
    """A way to damage a folder, the word of the finding, whether a run refuses it, and words of message and issue."""

    damage: Callable[[Path], object]
    word: str
    refused: bool
    message: str
    issue: str = ""


CASES = {
    # Report: nerfstudio-project/nerfstudio#3232.
    "thumbnail": Case(shrink_first, "odd_image_size", False, "48×32", "the image is 12×8"),
    # Report: scaleapi/pandaset-devkit#75.
    "forward": Case(turn_forward, "other_lidar", False, "d = 1"),
    # Report: nerfstudio-project/nerfstudio#1130.
    "image": Case(
        lambda f: link_to_unreadable(f / "camera/left/01.png"), "unreadable_image", False, "Input/output error"
    ),
    "sweep": Case(lambda f: link_to_unreadable(f / "lidar/01.pkl.gz"), "unreadable_sweep", False, "Input/output error"),
    # Report: none found; case 22 of the list of odd logs (a check that says usable, and a run that refuses).
    "cuboids": Case(
        lambda f: [p.write_bytes(b"") for p in f.glob("annotations/cuboids/*")], "unreadable_cuboids", False, "empty"
    ),
    "pose": Case(break_pose, "unreadable_pose", False, "the pose lacks"),
    "LiDAR pose": Case(break_lidar_pose, "lost_chunk", True, "the vehicle's pose is unreadable at frames 2"),
    "camera": Case(lambda f: (f / "camera/left/poses.json").write_text("{}"), "unreadable_camera", True, "0 keys"),
    # Report: noahzn/Lite-Mono#171.
    "counted from one": Case(count_from_one, "counted_from_one", True, "from 1 to 6"),
    # Report: git-lfs/git-lfs#4830.
    "pointers": Case(
        lambda f: [p.write_text(POINTER) for p in f.glob("camera/*/*.png")], "camera_without_images", True, "Git LFS"
    ),
    # Report: huggingface/datasets#4514.
    "names": Case(
        lambda f: [p.rename(p.with_name("x" + p.name)) for p in f.glob("camera/*/*.png")], "unread_files", True, "x00"
    ),
}


@pytest.mark.parametrize("name", CASES)
def test_check_and_ingest_judge_alike(folder: Path, name: str) -> None:
    case = CASES[name]
    case.damage(folder)
    check = check_log(open_pandaset(str(folder)))
    found = [finding for finding in check.findings if finding.word == case.word]
    assert found and case.message in found[0].message
    assert check.verdict == ("unusable" if case.refused else "usable")
    if case.refused:
        with pytest.raises(InputError) as caught:
            ingest(CONFIG, open_pandaset(str(folder)), 0)
        assert caught.value.remedy
    else:
        chunk = ingest(CONFIG, open_pandaset(str(folder)), 0)
        assert any((case.issue or case.message) in issue.detail for issue in chunk.log_issues)
    with pytest.raises(InputError):
        ingest(STRICT, open_pandaset(str(folder)), 0)


def test_a_run_without_images_says_what_lies_in_their_place(folder: Path) -> None:
    """Report: jinnovation/rainy-image-dataset#2."""
    for path in folder.glob("camera/*/*.png"):
        path.write_text(POINTER)
    with pytest.raises(InputError, match="a Git LFS pointer; run git lfs pull"):
        ingest(CONFIG, open_pandaset(str(folder)), 0)


def test_a_finding_of_a_camera_that_is_not_used_stops_nothing(folder: Path) -> None:
    count_from_one(folder)
    front = CONFIG.model_copy(update={"cameras": ("front",)})
    assert ingest(front, open_pandaset(str(folder)), 0).log_issues == ()


def test_a_sound_folder_gives_no_issue(written: Path) -> None:
    assert ingest(STRICT, open_pandaset(str(written)), 0).log_issues == ()
    assert check_log(open_pandaset(str(written))).verdict == "good"


def test_labels_as_categories_are_read(folder: Path) -> None:
    """Report: pandas-dev/pandas#61763 (dtypes of pandas in pickles)."""
    pd = pytest.importorskip("pandas")
    expected = check_log(open_pandaset(str(folder)))
    for path in folder.glob("annotations/cuboids/*.pkl.gz"):
        table = pd.read_pickle(path)
        table.assign(label=table["label"].astype("category")).to_pickle(path)
    check = check_log(open_pandaset(str(folder)))
    assert (check.tracks_moving, check.verdict) == (expected.tracks_moving, "good")
    assert ingest(STRICT, open_pandaset(str(folder)), 0).log_issues == ()


def damage_at_random(folder: Path, seed: int) -> None:
    """Truncates, empties, renames or replaces one file or folder."""
    random_source = random.Random(seed)
    path = random_source.choice(sorted(folder.glob("**/*")))
    kind = random_source.choice(["truncate", "empty", "rename", "remove", "link", "pipe", "folder"])
    if kind in ("truncate", "empty") and path.is_file():
        path.write_bytes(path.read_bytes()[: random_source.randrange(100) if kind == "truncate" else 0])
    elif kind == "rename":
        path.rename(path.with_name(random_source.choice([path.name.upper(), f"1{path.name}", f"{path.stem}.x"])))
    elif kind not in ("truncate", "empty"):
        shutil.rmtree(path) if path.is_dir() else path.unlink()
        make = {"link": lambda: path.symlink_to(path.name), "pipe": lambda: os.mkfifo(path), "folder": path.mkdir}
        make.get(kind, lambda: None)()


@pytest.mark.parametrize("seed", range(12))
def test_damaged_folders_are_judged_and_never_raise(folder: Path, seed: int) -> None:
    """Report: none found; cases 4, 13 and 21 of the list of odd logs, at random."""
    damage_at_random(folder, seed)
    try:
        log = open_pandaset(str(folder))
    except InputError as error:
        assert error.file is not None and error.remedy
        return
    assert len(log.digest()) == 64
    verdict = check_log(log).verdict
    try:
        ingest(CONFIG, log, 0)
    except InputError as error:
        assert verdict == "unusable" and error.remedy
    else:
        assert verdict != "unusable"


def judge_alike(folder: Path) -> tuple[LogCheck, str]:
    """What the check finds, and the words of the run's issues, or its error."""
    found = check_log(open_pandaset(str(folder)))
    try:
        chunk = ingest(IngestConfig(width_px=48, height_px=32, source_every=1), open_pandaset(str(folder)), 0)
    except InputError as error:
        return found, f"error: {error.problem}"
    return found, " ".join(issue.kind for issue in chunk.log_issues)


@pytest.mark.parametrize(
    ("columns", "check_text", "run_text"),
    [
        ({"x": np.nan}, "no LiDAR sweep has a point", "error: the LiDAR sweeps of the chunk have no point"),
        ({"i": None}, "lacks the columns i; it has", "error: the chunk has no LiDAR sweep that can be read; 6 cannot"),
    ],
)
def test_sweeps_without_points(folder: Path, columns: dict[str, float | None], check_text: str, run_text: str) -> None:
    """Report: none found; case 21 of the list of odd logs."""
    for file in folder.glob("lidar/*.pkl.gz"):
        count = read_table(file).row_count
        edit_table(file, **{name: None if v is None else np.full(count, v) for name, v in columns.items()})
    found, run = judge_alike(folder)
    assert found.verdict == "unusable" and run.startswith(run_text)
    assert sum(check_text in finding.message for finding in found.findings) == 1


def test_a_fault_of_all_poses_is_one_finding(folder: Path) -> None:
    """Report: none found; case 17 of the list of odd logs."""
    edit_json(folder / "lidar/poses.json", lambda poses: [{"translation": 0, "rotation": 0}] * len(poses))
    found, run = judge_alike(folder)
    unreadable = [finding for finding in found.findings if finding.word == "unreadable_pose"]
    assert len(unreadable) == 1 and unreadable[0].frames == tuple(range(found.frames))
    assert "the keys translation, rotation" in unreadable[0].message and "the keys translation, rotation" in run


@pytest.mark.parametrize(("make_id", "word"), [(lambda frame: "same", "repeated_box_id"), (str, "brief_tracks")])
def test_ids_of_boxes_that_name_no_object(folder: Path, make_id: Callable[[int], str], word: str) -> None:
    """Report: none found; case 4 of the list of odd logs."""
    for frame, file in enumerate(sorted(folder.glob("annotations/cuboids/*.pkl.gz"))):
        # Another frame's id alone, or the same for all.
        count = read_table(file).row_count
        ids = [make_id(frame) if word == "repeated_box_id" else f"{make_id(frame)}-{row}" for row in range(count)]
        edit_table(file, uuid=np.array(ids, dtype=object))
    found, run = judge_alike(folder)
    assert word in {finding.word for finding in found.findings} and word in run and found.verdict == "usable"


def test_a_key_that_stands_twice(folder: Path) -> None:
    """Report: none found; case 15 of the list of odd logs."""
    file = folder / "camera/left/intrinsics.json"
    file.write_text(file.read_text().replace('{"fx"', '{"fx": 1.0, "fx"'))
    found, run = judge_alike(folder)
    assert found.verdict == "unusable" and "the key fx stands twice" in run
