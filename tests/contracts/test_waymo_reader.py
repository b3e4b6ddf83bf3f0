"""The Waymo reader keeps the readers' contract on small written segments."""

from __future__ import annotations

import pytest

from genre_tasks.logs.registry import open_log
from genre_tasks.logs.types import DrivingLog
from tests.contracts.reader_suite import ReaderSuite
from tests.fakes import FakeLog
from tests.logs.waymo_folder import write_waymo


class TestWrittenSegment(ReaderSuite):
    missing_images = frozenset({("FRONT", 2), ("SIDE_LEFT", 7)})
    missing_sweeps = frozenset({4})
    front_camera = "FRONT"
    rows_in_group = 3
    uri: str

    @pytest.fixture(autouse=True, scope="class")
    @classmethod
    def written(cls, tmp_path_factory: pytest.TempPathFactory) -> None:
        fake = FakeLog(frame_count=8, camera_names=("front", "left"), lidar_azimuths=720, lidar_rings=48)
        fake = fake.with_(missing_images=frozenset({("front", 2), ("left", 7)}), missing_sweeps=cls.missing_sweeps)
        folder = tmp_path_factory.mktemp("waymo")
        cls.uri = f"waymo:{write_waymo(fake, folder, rows_in_group=cls.rows_in_group)}"

    def open(self) -> DrivingLog:
        return open_log(self.uri)


class TestOneGroupOfRows(TestWrittenSegment):
    """All rows of a file in one group, which is read from its beginning."""

    rows_in_group = 1000
