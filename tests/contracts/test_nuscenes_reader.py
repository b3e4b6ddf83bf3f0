"""The nuScenes reader keeps the readers' contract on small written scenes."""

from __future__ import annotations

import pytest

from genre_tasks.logs.registry import open_log
from genre_tasks.logs.types import DrivingLog
from tests.contracts.reader_suite import ReaderSuite
from tests.fakes import FakeLog
from tests.logs.nuscenes_folder import write_nuscenes


class TestWrittenScene(ReaderSuite):
    missing_images = frozenset({("CAM_FRONT", 2), ("CAM_LEFT", 7)})
    missing_sweeps = frozenset({4})
    front_camera = "CAM_FRONT"
    key_every = 1
    uri: str

    @pytest.fixture(autouse=True, scope="class")
    @classmethod
    def written(cls, tmp_path_factory: pytest.TempPathFactory) -> None:
        fake = FakeLog(frame_count=8, camera_names=("front", "left"), lidar_azimuths=720, lidar_rings=48)
        fake = fake.with_(missing_images=frozenset({("front", 2), ("left", 7)}), missing_sweeps=cls.missing_sweeps)
        folder = tmp_path_factory.mktemp("nuscenes")
        cls.uri = f"nuscenes:{write_nuscenes(fake, folder, key_every=cls.key_every)}"

    def open(self) -> DrivingLog:
        return open_log(self.uri)


class TestBoxesOfKeyFrames(TestWrittenScene):
    """Boxes of every seventh frame, as fast cameras and slow boxes have it."""

    key_every = 7
