"""``genre convert``: any log in the layout of GenRe or of PandaSet."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from typer.testing import CliRunner

from flows.cli.main import app
from genre_tasks.errors import ConfigError, InputError
from genre_tasks.logs.pandaset.writer import write_pandaset
from genre_tasks.logs.registry import open_log
from tests.fakes import FakeLog


@pytest.fixture
def uri(tmp_path: Path) -> str:
    fake = FakeLog(frame_count=3, camera_names=("front",), lidar_azimuths=60, lidar_rings=8)
    return f"pandaset:{write_pandaset(fake, tmp_path / '007')}"


@pytest.mark.parametrize("layout", ["genre", "pandaset"])
def test_convert(uri: str, layout: str, tmp_path: Path) -> None:
    target = f"{layout}:{tmp_path / 'out'}"
    done = CliRunner().invoke(app, ["convert", uri, target, "--json"], catch_exceptions=False)
    assert done.exit_code == 0
    record = json.loads(done.stdout)
    assert (record["written"], record["frames"], record["cameras"], record["tracks"]) == (target, 3, 1, 2)
    assert open_log(target).image_bytes("front", 2) == open_log(uri).image_bytes("front", 2)


@pytest.mark.parametrize("target", ["kitti:out", "out", "genre:"])
def test_a_layout_that_cannot_be_written(uri: str, target: str) -> None:
    with pytest.raises(ConfigError, match="names no layout"):
        CliRunner().invoke(app, ["convert", uri, target], catch_exceptions=False)


def test_a_folder_that_holds_something(uri: str, tmp_path: Path) -> None:
    (tmp_path / "out").mkdir()
    (tmp_path / "out/notes.txt").write_text("mine")
    with pytest.raises(InputError, match="holds something already"):
        CliRunner().invoke(app, ["convert", uri, f"genre:{tmp_path / 'out'}"], catch_exceptions=False)
    assert [path.name for path in (tmp_path / "out").iterdir()] == ["notes.txt"]
