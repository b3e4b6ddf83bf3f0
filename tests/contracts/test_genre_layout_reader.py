"""The reader of the minimal layout keeps the readers' contract: on a small written log, and on converted real ones."""

from __future__ import annotations

from pathlib import Path

import pytest

from genre_tasks.logs.genre_layout.writer import write_genre_layout
from genre_tasks.logs.registry import open_log
from genre_tasks.logs.types import DrivingLog
from tests.contracts.reader_suite import ReaderSuite
from tests.fakes import FakeLog


class TestWrittenLog(ReaderSuite):
    missing_images = frozenset({("front", 2), ("left", 7)})
    missing_sweeps = frozenset({4})
    folder: Path

    @pytest.fixture(autouse=True, scope="class")
    @classmethod
    def written(cls, tmp_path_factory: pytest.TempPathFactory) -> None:
        fake = FakeLog(frame_count=8, camera_names=("front", "left"), lidar_azimuths=720, lidar_rings=48)
        fake = fake.with_(missing_images=cls.missing_images, missing_sweeps=cls.missing_sweeps)
        cls.folder = write_genre_layout(fake, tmp_path_factory.mktemp("genre") / "007")

    def open(self) -> DrivingLog:
        return open_log(f"genre:{self.folder}")
