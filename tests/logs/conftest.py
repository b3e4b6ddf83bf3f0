"""A small PandaSet folder for each test to break."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

from genre_tasks.logs.pandaset.writer import write_pandaset
from tests.logs.pandaset_folder import small_log


@pytest.fixture(scope="module")
def written(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_pandaset(small_log(), tmp_path_factory.mktemp("source") / "002")


@pytest.fixture
def folder(written: Path, tmp_path: Path) -> Path:
    shutil.copytree(written, tmp_path / "002")
    return tmp_path / "002"
