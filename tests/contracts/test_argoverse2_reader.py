"""The Argoverse 2 reader keeps the readers' contract on a small written log."""

from __future__ import annotations

from pathlib import Path

import pytest

from genre_tasks.logs.registry import open_log
from genre_tasks.logs.types import DrivingLog
from tests.contracts.reader_suite import ReaderSuite
from tests.fakes import FakeLog
from tests.logs.argoverse2_folder import write_argoverse2


class TestWrittenLog(ReaderSuite):
    missing_images = frozenset({("ring_front", 2), ("ring_left", 7)})
    front_camera = "ring_front"
    folder: Path

    @pytest.fixture(autouse=True, scope="class")
    @classmethod
    def written(cls, tmp_path_factory: pytest.TempPathFactory) -> None:
        fake = FakeLog(frame_count=8, camera_names=("front", "left"), lidar_azimuths=720, lidar_rings=48)
        fake = fake.with_(missing_images=frozenset({("front", 2), ("left", 7)}))
        cls.folder = write_argoverse2(fake, tmp_path_factory.mktemp("argoverse2") / "log-1")

    def open(self) -> DrivingLog:
        return open_log(f"argoverse2:{self.folder}")
