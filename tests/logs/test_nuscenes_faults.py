"""nuScenes: whatever is wrong with the tables is one error that names the table and what to do."""

from __future__ import annotations

import json
import os
import shutil
import sqlite3
import tracemalloc
from collections.abc import Callable
from contextlib import closing
from pathlib import Path
from typing import Any

import pytest

from genre_tasks.errors import ConfigError, InputError, ResourceError
from genre_tasks.logs.nuscenes.json_rows import stream_rows
from genre_tasks.logs.nuscenes.scene_address import list_scenes
from genre_tasks.logs.registry import open_log
from tests.fakes import FakeLog
from tests.logs.nuscenes_folder import VERSION, change_table, write_nuscenes

FAKE = FakeLog(frame_count=3, camera_names=("front",), lidar_azimuths=24, lidar_rings=4, width_px=16, height_px=12)
TABLES = ("scene", "sample", "sensor", "calibrated_sensor", "sample_data", "ego_pose", "category", "instance")
# What SQLite reads and writes at once.
_PAGE_BYTES = 4096


@pytest.fixture(scope="module")
def written(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("nuscenes")
    write_nuscenes(FAKE, root)
    return root


@pytest.fixture
def root(written: Path, tmp_path: Path) -> Path:
    """A dataset for a test to break."""
    shutil.copytree(written, tmp_path / "nuscenes")
    return tmp_path / "nuscenes"


def _set(table: str, column: str, value: Any) -> Callable[[Path], None]:
    return lambda root: change_table(root, table, lambda rows: rows[0].__setitem__(column, value))


def _write(table: str, text: str) -> Callable[[Path], None]:
    return lambda root: (root / VERSION / f"{table}.json").write_text(text)


def _cut(root: Path) -> None:
    path = root / VERSION / "ego_pose.json"
    path.write_text(path.read_text()[:-200])


def _repeat(root: Path) -> None:
    change_table(root, "ego_pose", lambda rows: rows.append(rows[0]))


def _damage_middle(table: str, old: str, new: str) -> Callable[[Path], None]:
    """Replaces the text that stands between two rows, near the middle of a table."""

    def change(root: Path) -> None:
        path = root / VERSION / f"{table}.json"
        text = path.read_text()
        at = text.index(old, len(text) // 2)
        path.write_text(text[:at] + new + text[at + len(old) :])

    return change


def _spoil(root: Path) -> None:
    path = root / VERSION / "ego_pose.json"
    data = path.read_bytes()
    half = len(data) // 2
    path.write_bytes(data[:half] + b"\xff" * 64 + data[half + 64 :])


BROKEN: dict[str, tuple[Callable[[Path], None], str, str]] = {
    "a sensor that is not there": (
        _set("calibrated_sensor", "sensor_token", "x"),
        "points to a row of sensor",
        "sensor",
    ),
    "a pose that is not there": (_set("sample_data", "ego_pose_token", "x"), "row of ego_pose .* 'x'", "ego_pose"),
    "a calibration that is not there": (
        _set("sample_data", "calibrated_sensor_token", "x"),
        "points to a row of calibrated_sensor",
        "calibrated_sensor",
    ),
    "an object that is not there": (_set("sample_annotation", "instance_token", "x"), "row of instance", "instance"),
    "a category that is not there": (_set("instance", "category_token", "x"), "row of category", "category"),
    "no such column": (_set("sample", "timestamp", None), r"row 0 .* in column timestamp", "sample"),
    "text for a number": (_set("ego_pose", "translation", ["0", 1, 2]), "in column translation", "ego_pose"),
    "too few numbers": (_set("ego_pose", "rotation", [1, 0, 0]), "list of 4 numbers", "ego_pose"),
    "no number": (_set("ego_pose", "translation", [0, float("nan"), 0]), "finite number", "ego_pose"),
    "no turn": (_set("ego_pose", "rotation", [0, 0, 0, 0]), "quaternion is zero", "ego_pose"),
    "two sizes": (_set("sample_annotation", "size", [1, 1]), "list of 3 numbers", "sample_annotation"),
    "a size of text": (_set("sample_annotation", "size", ["1", 1, 1]), "finite number", "sample_annotation"),
    "half a character": (_set("scene", "name", "\ud800"), "row 0", "scene"),
    "a camera elsewhere": (
        lambda root: change_table(root, "sensor", lambda rows: [{**row, "channel": "../x"} for row in rows]),
        "cannot be a folder's name",
        "sensor",
    ),
    "a file elsewhere": (_set("sample_data", "filename", "../../etc/passwd"), "outside of the root", "sample_data"),
    "no lens": (
        lambda root: change_table(root, "calibrated_sensor", lambda rows: rows[2].update(camera_intrinsic=[])),
        "CAM_FRONT has no positive focal lengths",
        "calibrated_sensor",
    ),
    "a token twice": (_repeat, "two rows have the same token", "ego_pose"),
    "cut off": (_cut, "no list of JSON objects", "ego_pose"),
    "a list that ends before its rows do": (
        _damage_middle("sample_annotation", "},\n{", "}]\n{"),
        r"after \d+ rows: '{' stands behind the end of the list",
        "sample_annotation",
    ),
    "two rows in one": (
        _damage_middle("sample_annotation", "},\n{", ",\n"),
        r"after \d+ rows: the key token stands twice",
        "sample_annotation",
    ),
    "zeros in a row": (
        _damage_middle("sample_annotation", '"rotation"', "\0" * 10),
        r"after \d+ rows: Expecting property name",
        "sample_annotation",
    ),
    "no text": (_spoil, "after 0 rows: bytes are no UTF-8", "ego_pose"),
    "an object for a list": (_write("sample", "{}"), r"'\['", "sample"),
    "a list of numbers": (_write("sample", "[1, 2]"), "an object was expected", "sample"),
    "nested without end": (_write("sample", '[{"a":' + "[" * 200_000), "no list of JSON objects", "sample"),
    "a pointer": (_write("sample", "version https://git-lfs.github.com/spec/v1\n"), "Git LFS pointer", "sample"),
    "empty": (_write("sensor", ""), "the file is empty", "sensor"),
    "no scenes": (_write("scene", "[]"), "has 0 scenes of the name 'scene-0061'", "scene"),
}
BROKEN |= {
    f"without {name}": (lambda root, name=name: (root / VERSION / f"{name}.json").unlink(), "is missing", name)
    for name in (*TABLES[1:], "sample_annotation")
}


@pytest.mark.parametrize("name", BROKEN)
def test_a_broken_table_is_an_error_that_names_it(root: Path, name: str) -> None:
    break_it, problem, table = BROKEN[name]
    break_it(root)
    with pytest.raises(InputError, match=problem) as caught:
        open_log(f"nuscenes:{root}/scene-0061")
    assert caught.value.file == str(root / VERSION / f"{table}.json")
    assert caught.value.remedy
    assert caught.value.log == f"nuscenes:{root}/scene-0061"


def test_another_layout(root: Path) -> None:
    for address, problem in (
        (f"{root}/samples/scene-0061", "no tables of nuScenes here"),
        (f"{root}/nowhere/scene-0061", "no such folder"),
        (f"{root}", "no scene is named"),
        (f"{root}/scene-0061?version=v1.0-trainval", "no version 'v1.0-trainval'"),
        ("", "no such folder"),
    ):
        with pytest.raises(InputError, match=problem):
            open_log(f"nuscenes:{address}")
    with pytest.raises(ConfigError, match="no option 'verion'"):
        open_log(f"nuscenes:{root}/scene-0061?verion=v1.0-mini")
    with pytest.raises(InputError) as caught:
        open_log(f"nuscenes:{root}/scene-0016")
    assert "Did you mean 'scene-0061'" in caught.value.remedy


def test_without_the_files_of_the_scene(root: Path) -> None:
    shutil.rmtree(root / "samples/LIDAR_TOP")
    log = open_log(f"nuscenes:{root}/scene-0061")
    assert log.sweep(0) is None
    shutil.rmtree(root / "samples")
    with pytest.raises(InputError, match="none of the scene's files is there, such as samples/LIDAR_TOP"):
        open_log(f"nuscenes:{root}/scene-0061")


def test_a_camera_without_images_is_left_out(root: Path) -> None:
    for path in (root / "samples/CAM_FRONT").iterdir():
        path.write_bytes(b"")
    log = open_log(f"nuscenes:{root}/scene-0061")
    assert log.cameras == ()
    assert {finding.word for finding in log.findings()} == {"unreadable_image", "camera_without_images"}


def test_an_index_that_cannot_be_written(root: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("GENRE_CACHE_DIR", str(root / VERSION / "scene.json"))
    with pytest.raises(ResourceError, match="index cannot be written"):
        open_log(f"nuscenes:{root}/scene-0061")


def _list_indexes(folder: Path) -> list[Path]:
    return list((folder / "nuscenes").iterdir())


@pytest.mark.parametrize("damage", ["empty", "zeros", "cut", "text", "other tables"])
def test_a_damaged_index_is_made_again(
    root: Path, damage: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As after a loss of power; it would be an error of every scene."""
    monkeypatch.setenv("GENRE_CACHE_DIR", str(tmp_path / "cache"))
    expected = open_log(f"nuscenes:{root}/scene-0061").digest()
    (path,) = _list_indexes(tmp_path / "cache")
    data = path.read_bytes()
    damaged = {"empty": b"", "zeros": bytes(len(data)), "cut": data[: len(data) // 2], "text": b"no index" * 1000}
    if damage == "other tables":
        path.unlink()
        with closing(sqlite3.connect(path)) as other:
            other.execute("CREATE TABLE scene (token TEXT)")
    else:
        path.write_bytes(damaged[damage])
    assert open_log(f"nuscenes:{root}/scene-0061").digest() == expected
    assert _list_indexes(tmp_path / "cache") == [path] and path.read_bytes() == data


def _clear(page: bytes) -> bytes:
    return bytes(len(page))


def _invert(page: bytes) -> bytes:
    return bytes(255 - byte for byte in page)


def _change_bit(page: bytes) -> bytes:
    # Rows fill a page from its end.
    return page[:-1] + bytes([page[-1] ^ 1])


@pytest.mark.parametrize("damage", [_clear, _invert, _change_bit])
def test_no_damaged_page_of_the_index_changes_a_scene(
    root: Path, damage: Callable[[bytes], bytes], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("GENRE_CACHE_DIR", str(tmp_path / "cache"))
    expected = open_log(f"nuscenes:{root}/scene-0061").digest()
    (path,) = _list_indexes(tmp_path / "cache")
    data = path.read_bytes()
    made_again = 0
    for start in range(0, len(data), _PAGE_BYTES):
        page = data[start : start + _PAGE_BYTES]
        damaged = data[:start] + damage(page) + data[start + _PAGE_BYTES :]
        path.write_bytes(damaged)
        assert open_log(f"nuscenes:{root}/scene-0061").digest() == expected
        # No scene needs the tokens of boxes, for example: such a page may stay as it is.
        assert path.read_bytes() in (data, damaged)
        made_again += path.read_bytes() == data
    assert made_again > len(data) // _PAGE_BYTES // 2


def test_a_damaged_name_in_the_index_hides_no_scene(
    root: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("GENRE_CACHE_DIR", str(tmp_path / "cache"))
    pattern = f"{root}/scene-*"
    expected = list_scenes(pattern)
    (path,) = _list_indexes(tmp_path / "cache")
    data = path.read_bytes()
    for read in (lambda: list_scenes(pattern), lambda: [open_log(f"nuscenes:{root}/scene-0061").uri[9:]]):
        path.write_bytes(data.replace(b"scene-0061", b"scene-0062"))
        assert read() == expected


def test_a_disk_that_damages_every_index_is_an_error(
    root: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("GENRE_CACHE_DIR", str(tmp_path / "cache"))
    fsync = os.fsync

    def spoil(handle: int) -> None:
        fsync(handle)
        for path in _list_indexes(tmp_path / "cache"):
            path.write_bytes(path.read_bytes().replace(b"scene-0061", b"scene-0062"))

    monkeypatch.setattr(os, "fsync", spoil)
    with pytest.raises(ResourceError, match="rows of the table scene are not those") as caught:
        open_log(f"nuscenes:{root}/scene-0061")
    assert "GENRE_CACHE_DIR" in caught.value.remedy


def test_an_index_reaches_the_disk_before_its_name_does(
    root: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("GENRE_CACHE_DIR", str(tmp_path / "cache"))
    synchronised = []

    def fsync(handle: int) -> None:
        synchronised.append((os.fstat(handle).st_ino, [path.name for path in _list_indexes(tmp_path / "cache")]))

    monkeypatch.setattr(os, "fsync", fsync)
    open_log(f"nuscenes:{root}/scene-0061")
    (path,) = _list_indexes(tmp_path / "cache")
    ((inode, names),) = synchronised
    assert inode == path.stat().st_ino and path.name not in names


@pytest.mark.parametrize("text", ["", " \n"])
@pytest.mark.parametrize("length", [1, 1000, (1 << 20) - 12, 1 << 20, 3 << 20])
def test_rows_of_any_length_are_split(tmp_path: Path, length: int, text: str) -> None:
    """Blocks of the file end within rows, texts and numbers."""
    rows = [{"token": "x" * length, "number": k * 1.5} for k in range(5)]
    path = tmp_path / "rows.json"
    path.write_text(f"{text}[" + f"{text},{text}".join(map(json.dumps, rows)) + f"{text}]")
    assert list(stream_rows(path, "log")) == rows


def test_a_row_without_end_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "rows.json"
    path.write_text('[{"token": "' + "x" * (12 << 20))
    with pytest.raises(InputError, match="no list of JSON objects"):
        list(stream_rows(path, "log"))


def test_a_large_table_takes_little_memory(tmp_path: Path) -> None:
    path = tmp_path / "rows.json"
    rows = [{"token": f"{k:032x}", "translation": [k, 1.5, 2.5], "text": "x" * 300} for k in range(50_000)]
    path.write_text(json.dumps(rows, indent=0))
    del rows
    assert path.stat().st_size > 18 << 20
    tracemalloc.start()
    try:
        assert sum(1 for _ in stream_rows(path, "log")) == 50_000
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert peak < 8 << 20
