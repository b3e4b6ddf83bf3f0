"""The detector as a guard: its boxes, what it finds of the log's actors, how far that holds, and what is refused."""

from __future__ import annotations

import math
import sys
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest
import torch

from genre_tasks.config import IngestConfig, RangeConfig
from genre_tasks.errors import ConfigError, InputError
from genre_tasks.logs.registry import open_log
from genre_tasks.metrics.scoring import decode_view_image
from genre_tasks.reliability.detector import MIN_HEIGHT_PX, Detector
from genre_tasks.reliability.guards import Guards
from genre_tasks.reliability.reliable_range import find_reliable_range
from genre_tasks.scene.box_projection import project_box
from genre_tasks.scene.chunk import Chunk
from genre_tasks.stages.ingest import ingest

REAL = Path("../shared/data")
GRID, CAR, CHAIR = 22, 2, 56


@dataclass
class Stub:
    """A network that finds boxes (x, y, x, y as shares of the image) of a class, whatever it is shown."""

    boxes: list[tuple[float, float, float, float]]
    label: int = CAR

    def get_inputs(self) -> list[Stub]:
        return [self]

    @property
    def name(self) -> str:
        return "image"

    def run(self, _: None, given: dict[str, np.ndarray]) -> list[np.ndarray]:
        assert given["image"].shape == (1, 3, 352, 352) and given["image"].dtype == np.float32
        out = np.zeros((1, 85, GRID, GRID), np.float32)
        for x0, y0, x1, y1 in self.boxes:
            x, y = GRID * (x0 + x1) / 2, GRID * (y0 + y1) / 2
            cell = out[0, :, int(y), int(x)]
            cell[0], cell[5 + self.label] = 0.9, 0.9
            cell[1:3] = np.arctanh([x - int(x), y - int(y)])
            cell[3:5] = [math.log(s / (1 - s)) for s in (x1 - x0, y1 - y0)]
        return [out]


@pytest.fixture(scope="module")
def chunk() -> Chunk:
    config = IngestConfig(width_px=160, height_px=90)
    return ingest(config, open_log("synthetic:street?seed=900&frames=8&cameras=1&width=160&height=90"), 0)


def test_boxes_are_where_the_network_says_and_of_road_users_alone() -> None:
    box = (0.31, 0.42, 0.52, 0.66)
    image = torch.rand(90, 160, 3)
    assert Detector(Stub([box]), 352).detect_boxes(image) == pytest.approx(
        np.array([box]) * [160, 90, 160, 90], abs=1e-3
    )
    assert Detector(Stub([box], CHAIR), 352).detect_boxes(image).shape == (0, 4)


def test_actors_are_found_where_they_are(chunk: Chunk) -> None:
    view, image = chunk.views[0], torch.zeros(90, 160, 3)
    boxes = [np.concatenate(project_box(actor, view)) for actor in chunk.actors]
    whole = [b for b in boxes if b[0] > 0 and b[1] > 0 and b[2] < 160 and b[3] < 90 and b[3] - b[1] >= MIN_HEIGHT_PX]
    shares = [tuple(float(x) for x in b / [160, 90, 160, 90]) for b in whole]
    assert whole
    assert Detector(Stub(shares), 352).count_detected_actors(chunk, view, image) == (len(whole), len(whole))
    assert Detector(Stub([]), 352).count_detected_actors(chunk, view, image) == (len(whole), 0)
    aside = [(x0, y0 - 0.6 * (y1 - y0), x1, y1 - 0.6 * (y1 - y0)) for x0, y0, x1, y1 in shares]
    assert Detector(Stub(aside[:1]), 352).count_detected_actors(chunk, view, image)[1] == 0
    assert Detector(Stub(shares), 352).count_detected_actors(replace(chunk, actors=()), view, image) == (0, 0)


def guard(shift: float, actors: int, detected: int) -> Guards:
    return Guards("front", 0, shift, 90.0, 0.7, 0.0, 0.0, actors, detected)


def test_the_range_ends_where_too_much_is_no_longer_detected() -> None:
    limits = RangeConfig(shifts_m=(1.0, 2.0), max_drop_db=60.0, max_undetected=0.3)
    left = [guard(1.0, 10, 8), guard(2.0, 10, 2)]  # nothing lost, then three quarters
    right = [guard(-1.0, 0, 0), guard(-2.0, 5, 4)]  # nothing in view, then nothing lost
    found = find_reliable_range([guard(0.0, 10, 8), *left, *right], limits)
    assert found.left_m == pytest.approx(1 + 0.3 / 0.75) and found.right_m == 2.0
    by = {p.shift_m: p.detected for p in found.points}
    assert by[0.0] == by[1.0] == 0.8 and by[2.0] == 0.2 and math.isnan(by[-1.0])
    without = find_reliable_range([guard(s, 0, 0) for s in (0.0, 1.0, 2.0)], limits)
    assert without.left_m == 2.0 and all(math.isnan(p.detected) for p in without.points)


def test_what_is_no_detector_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(InputError, match="no such detector"):
        Detector.load(tmp_path / "none.onnx")
    (tmp_path / "text.onnx").write_text("no network")
    with pytest.raises(InputError, match="the detector cannot be read"):
        Detector.load(tmp_path / "text.onnx")
    monkeypatch.setitem(sys.modules, "onnxruntime", None)
    with pytest.raises(ConfigError, match=r"genre\[perception\]"):
        Detector.load(tmp_path / "text.onnx")


@pytest.mark.skipif(not (REAL / "detectors/FastestDet.onnx").is_file(), reason="the detector is not there")
def test_a_real_detector_finds_the_cars_of_recorded_images(chunk: Chunk) -> None:
    detector = Detector.load(REAL / "detectors/FastestDet.onnx")
    config = IngestConfig(width_px=320, height_px=180)
    real = ingest(config, open_log(f"pandaset:{REAL / 'pandaset/002'}"), 0)
    views = [v for v in real.views if v.camera == "front_camera"][::4]
    found = np.sum([detector.count_detected_actors(real, v, decode_view_image(v)) for v in views], 0)
    blank = np.sum([detector.count_detected_actors(real, v, torch.full((180, 320, 3), 0.5)) for v in views], 0)
    assert found[0] >= 4 and found[1] >= 0.5 * found[0] and blank.tolist() == [found[0], 0]
