"""The PandaSet reader keeps the readers' contract: on a small written log, and on the real sequence."""

from __future__ import annotations

from pathlib import Path

import pytest

from genre_tasks.logs.pandaset.writer import write_pandaset
from genre_tasks.logs.registry import open_log
from genre_tasks.logs.types import DrivingLog
from tests.contracts.reader_suite import ReaderSuite
from tests.fakes import FakeLog

REAL = Path(__file__).resolve().parents[3] / "shared/data/pandaset/002"


class TestWrittenLog(ReaderSuite):
    missing_images = frozenset({("front", 2), ("left", 7)})
    missing_sweeps = frozenset({4})
    folder: Path

    @pytest.fixture(autouse=True, scope="class")
    @classmethod
    def written(cls, tmp_path_factory: pytest.TempPathFactory) -> None:
        fake = FakeLog(frame_count=8, camera_names=("front", "left"), lidar_azimuths=720, lidar_rings=48)
        fake = fake.with_(missing_images=cls.missing_images, missing_sweeps=cls.missing_sweeps)
        cls.folder = write_pandaset(fake, tmp_path_factory.mktemp("pandaset") / "007")

    def open(self) -> DrivingLog:
        return open_log(f"pandaset:{self.folder}")


@pytest.mark.real
@pytest.mark.skipif(not REAL.is_dir(), reason=f"no PandaSet sequence beside the checkout ({REAL})")
class TestRealSequence(ReaderSuite):
    missing_sweeps = frozenset({28, 29, 30})

    def open(self) -> DrivingLog:
        return open_log(f"pandaset:{REAL}")
