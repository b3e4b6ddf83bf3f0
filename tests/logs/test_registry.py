"""Readers by name: lazy, and clear about what is known."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from genre_tasks.errors import InputError
from genre_tasks.logs import registry
from genre_tasks.logs.log_address import split_log_address
from genre_tasks.logs.registry import known_readers, make_log_absolute, open_log, register
from tests.fakes import FakeLog


@pytest.fixture(autouse=True)
def own_readers(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(registry, "_READERS", dict(registry._READERS))


def open_fake(rest: str) -> FakeLog:
    return FakeLog(uri=f"fake:{rest}")


def test_known_readers() -> None:
    assert known_readers() == (
        "argoverse2",
        "genre",
        "kitti",
        "nuscenes",
        "pandaset",
        "posed_images",
        "synthetic",
        "waymo",
    )


def test_a_reader_is_one_line() -> None:
    register("fake", f"{__name__}:open_fake", "nothing", example="fake:street")
    assert open_log("fake:over:there?x=1").uri == "fake:over:there?x=1"
    register("fake", f"{__name__}:open_fake", "nothing")
    with pytest.raises(ValueError, match="exists already"):
        register("fake", "elsewhere:open_fake", "nothing")


@pytest.mark.parametrize(
    ("uri", "said"),
    [
        ("pandset:x/002", "unknown reader 'pandset'.*Did you mean 'pandaset'"),
        ("PandaSet:x/002", "unknown reader 'PandaSet'.*Did you mean 'pandaset'"),
        (
            "rosbag:x",
            r"unknown reader 'rosbag'.*Known: .*kitti:\S+, nuscenes:\S+, pandaset:PATH/002, posed_images:\S+, syn",
        ),
        ("../data/002", "names no reader.*Known: .*pandaset:PATH/002"),
        ("", "names no reader"),
    ],
)
def test_unknown(uri: str, said: str) -> None:
    with pytest.raises(InputError, match=said):
        open_log(uri)


def test_a_missing_package_says_what_to_install() -> None:
    register("far", "no_such_package_anywhere:open", "pip install far-reader")
    with pytest.raises(InputError, match="pip install far-reader"):
        open_log("far:x")


def test_no_such_path(tmp_path: Path) -> None:
    with pytest.raises(InputError) as caught:
        open_log(f"pandaset:{tmp_path}/nowhere/002")
    assert caught.value.file == f"{tmp_path}/nowhere/002"
    assert caught.value.log == f"pandaset:{tmp_path}/nowhere/002"


def test_readers_are_imported_when_used() -> None:
    code = "import sys, genre_tasks.logs.registry; print([m for m in sys.modules if 'pandaset' in m or 'trimesh' in m])"
    root = Path(__file__).resolve().parents[2]
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, cwd=root)
    assert done.stdout.strip() == "[]"


def test_a_folders_name_may_look_like_an_address(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = tmp_path / "R&D 100%25?"
    (folder / "a log").mkdir(parents=True)
    monkeypatch.chdir(folder)
    monkeypatch.setenv("HOME", str(folder))
    for given in ("kitti:a log?labels=l.txt", "kitti:~/a%20log?labels=~/l.txt"):
        path, options = split_log_address(make_log_absolute(given).removeprefix("kitti:"), ("labels",), "KITTI")
        assert (path, options) == (f"{folder}/a log", {"labels": f"{folder}/l.txt"})
    # Readers that take a path as it is get it as it is.
    assert make_log_absolute("pandaset:002") == f"pandaset:{folder}/002"
    assert make_log_absolute("kitti:/data/a%20log") == "kitti:/data/a%20log"
