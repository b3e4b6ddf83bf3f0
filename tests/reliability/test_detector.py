"""The detector as a guard: what it finds of the log's actors, how far that holds, and what is refused."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest
import torch

from genre_tasks.config import IngestConfig, RangeConfig
from genre_tasks.detection.coco_classes import COCO_CLASSES
from genre_tasks.detection.detections import Detections
from genre_tasks.errors import InputError
from genre_tasks.logs.registry import open_log
from genre_tasks.metrics.scoring import decode_view_image
from genre_tasks.reliability import detected_actors
from genre_tasks.reliability.detected_actors import MIN_HEIGHT_PX, count_detected_actors, open_actor_detector
from genre_tasks.reliability.guards import Guards
from genre_tasks.reliability.reliable_range import find_reliable_range
from genre_tasks.scene.box_projection import project_box
from genre_tasks.scene.chunk import Chunk
from genre_tasks.stages.ingest import ingest

REAL = Path("../shared/data")
CAR, CHAIR = 2, 56


@dataclass
class Stub:
    """A detector that finds boxes of a class, whatever it is shown."""

    boxes: list[np.ndarray]
    label: int = CAR
    class_names: tuple[str, ...] = COCO_CLASSES
    has_masks: bool = False

    def detect(self, image: np.ndarray) -> Detections:
        assert image.shape == (90, 160, 3) and image.dtype == np.uint8
        count = len(self.boxes)
        boxes = np.array(self.boxes, np.float32).reshape(count, 4)
        return Detections(boxes, np.full(count, 0.9, np.float32), np.full(count, self.label))


@pytest.fixture(scope="module")
def chunk() -> Chunk:
    config = IngestConfig(width_px=160, height_px=90)
    return ingest(config, open_log("synthetic:street?seed=900&frames=8&cameras=1&width=160&height=90"), 0)


def test_actors_are_found_where_they_are(chunk: Chunk) -> None:
    view, image = chunk.views[0], torch.zeros(90, 160, 3)
    boxes = [np.concatenate(project_box(actor, view)) for actor in chunk.actors]
    whole = [b for b in boxes if b[0] > 0 and b[1] > 0 and b[2] < 160 and b[3] < 90 and b[3] - b[1] >= MIN_HEIGHT_PX]
    assert whole
    assert count_detected_actors(Stub(whole), chunk, view, image) == (len(whole), len(whole))
    assert count_detected_actors(Stub(whole, CHAIR), chunk, view, image) == (len(whole), 0)
    assert count_detected_actors(Stub([]), chunk, view, image) == (len(whole), 0)
    above = whole[0] - np.array([0, 0.6, 0, 0.6]) * (whole[0][3] - whole[0][1])
    assert count_detected_actors(Stub([above]), chunk, view, image)[1] == 0
    assert count_detected_actors(Stub(whole), replace(chunk, actors=()), view, image) == (0, 0)


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


def test_a_detector_without_road_users_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(detected_actors, "open_detector", lambda name, min_score: Stub([], 0, ("tree", "pole")))
    with pytest.raises(InputError, match=r"knows no road users.*x\.onnx.*person, bicycle, car"):
        open_actor_detector("x.onnx")


def test_finds_count_from_the_score_of_the_guide(monkeypatch: pytest.MonkeyPatch) -> None:
    scores: list[float] = []

    def open_stub(name: str, min_score: float) -> Stub:
        scores.append(min_score)
        return Stub([])

    monkeypatch.setattr(detected_actors, "open_detector", open_stub)
    open_actor_detector("x.onnx")
    guide = (Path(__file__).resolve().parents[2] / "docs/guides/reliable-range.md").read_text()
    assert f"Its finds of a score of at least {scores[0]} count." in guide


@pytest.mark.parametrize("name", ["FastestDet.onnx", "yolox_nano.onnx", "yolov8n-seg_int8.tflite"])
def test_a_real_detector_finds_the_cars_of_recorded_images(name: str) -> None:
    if not (REAL / "detectors" / name).is_file():
        pytest.skip("the detector is not there")
    detector = open_actor_detector(str(REAL / "detectors" / name))
    config = IngestConfig(width_px=320, height_px=180)
    real = ingest(config, open_log(f"pandaset:{REAL / 'pandaset/002'}"), 0)
    views = [v for v in real.views if v.camera == "front_camera"][::4]
    grey = torch.full((180, 320, 3), 0.5)
    found = np.sum([count_detected_actors(detector, real, v, decode_view_image(v)) for v in views], 0)
    blank = np.sum([count_detected_actors(detector, real, v, grey) for v in views], 0)
    assert found[0] >= 4 and found[1] >= 0.5 * found[0] and blank.tolist() == [found[0], 0]
