"""The KITTI reader keeps the readers' contract: on small written drives, and on the real one."""

from __future__ import annotations

from pathlib import Path

import pytest

from genre_tasks.logs.registry import open_log
from genre_tasks.logs.types import DrivingLog
from tests.contracts.reader_suite import ReaderSuite
from tests.fakes import FakeLog
from tests.logs.kitti_folder import write_kitti, write_tracking_labels

KITTI = Path(__file__).resolve().parents[3] / "shared/data/kitti"
DRIVE = KITTI / "2011_09_26/2011_09_26_drive_0009_sync"
LABELS = KITTI / "tracking_labels/0001_first20.txt"


class TestWrittenDrive(ReaderSuite):
    missing_images = frozenset({("image_02", 2)})
    missing_sweeps = frozenset({4})
    front_camera = "image_02"
    uri: str

    @pytest.fixture(autouse=True, scope="class")
    @classmethod
    def written(cls, tmp_path_factory: pytest.TempPathFactory) -> None:
        fake = FakeLog(frame_count=8, camera_names=("front",), lidar_azimuths=720, lidar_rings=48)
        fake = fake.with_(missing_images=frozenset({("front", 2)}), missing_sweeps=cls.missing_sweeps)
        folder = tmp_path_factory.mktemp("kitti")
        cls.uri = f"kitti:{write_kitti(fake, folder)}"

    def open(self) -> DrivingLog:
        return open_log(self.uri)


class TestWrittenTrackingLabels(TestWrittenDrive):
    @pytest.fixture(autouse=True, scope="class")
    @classmethod
    def written(cls, tmp_path_factory: pytest.TempPathFactory) -> None:
        fake = FakeLog(frame_count=8, camera_names=("front",), lidar_azimuths=720, lidar_rings=48)
        fake = fake.with_(missing_images=frozenset({("front", 2)}), missing_sweeps=cls.missing_sweeps)
        folder = tmp_path_factory.mktemp("kitti")
        drive = write_kitti(fake, folder, with_tracklets=False)
        cls.uri = f"kitti:{drive}?labels={write_tracking_labels(fake, folder / 'labels.txt')}"


@pytest.mark.real
@pytest.mark.skipif(not DRIVE.is_dir(), reason=f"no KITTI drive beside the checkout ({DRIVE})")
class TestRealDrive(ReaderSuite):
    front_camera = "image_02"

    def open(self) -> DrivingLog:
        return open_log(f"kitti:{DRIVE}?labels={LABELS}")
