"""Images with poses keep the readers' contract: transforms.json, and COLMAP in other axes and units."""

from __future__ import annotations

import tempfile
from pathlib import Path

import pytest

from genre_tasks.logs.registry import open_log
from genre_tasks.logs.types import DrivingLog
from tests.contracts.reader_suite import ReaderSuite
from tests.logs.posed_images_folder import write_colmap, write_transforms

pytest.importorskip("embreex", reason="the synthetic street is ray-cast with Embree")


class _PosedImages(ReaderSuite):
    missing_sweeps = frozenset(range(8))
    has_sweeps = False
    has_tracks = False
    uri = ""

    def open(self) -> DrivingLog:
        cls = type(self)
        if not cls.uri:
            cls.uri = self.write(Path(tempfile.mkdtemp(prefix="genre-posed-images-")))
        return open_log(cls.uri)

    def write(self, folder: Path) -> str:
        raise NotImplementedError


class TestTransforms(_PosedImages):
    def write(self, folder: Path) -> str:
        return f"posed_images:{write_transforms(folder)}"


class TestColmap(_PosedImages):
    def write(self, folder: Path) -> str:
        return f"posed_images:{write_colmap(folder, binary=True)}?scale=2.5"


del _PosedImages
