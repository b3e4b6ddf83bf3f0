"""A network becomes a detector: images fitted, overlaps suppressed, boxes and masks in the image, names, drawing."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from genre_tasks.detection.class_names import find_stored_names
from genre_tasks.detection.coco_classes import COCO_CLASSES, find_road_users
from genre_tasks.detection.detections import Detections
from genre_tasks.detection.drawing import choose_color, draw_detections
from genre_tasks.detection.image_fit import fit_image
from genre_tasks.detection.output_forms import Family, OutputForm
from genre_tasks.detection.suppression import suppress_overlaps
from genre_tasks.detection.yolo_detector import YoloDetector
from genre_tasks.errors import InputError
from tests.detection.fake_network import FakeNetwork, yolov8_rows

SIZE = (64, 64)
FILE = Path("x.onnx")
WIDE = np.zeros((60, 120, 3), np.uint8)
"""An image that comes to 32 × 64 pixels, with 16 rows of margin above and below it."""


def detector(finds: list[tuple[int, list[float]]], names: tuple[str, ...] = COCO_CLASSES[:8]) -> YoloDetector:
    rows = yolov8_rows(SIZE, finds, len(names))
    return YoloDetector.from_network(FakeNetwork(SIZE, [rows], {"names": repr(list(names))}), FILE)


def test_margins_are_where_the_family_expects_them() -> None:
    image = np.zeros((60, 120, 3), np.uint8)
    image[..., 0] = 255
    for family, top in ((Family.YOLOV8, 16), (Family.YOLOX, 0)):
        form = OutputForm(family, 80)
        values, placement = fit_image(image, SIZE, form)
        red = 2 if form.blue_first else 0
        assert placement.offset == (0, top) and placement.scale == pytest.approx((64 / 120, 32 / 60))
        content = values[0, :, top : top + 32]
        assert (content[red] == 255 / form.divisor).all() and (content[1] == 0).all()
        margin = np.delete(values[0], np.s_[top : top + 32], axis=1)
        assert margin == pytest.approx(114 / form.divisor)
    values, placement = fit_image(image, SIZE, OutputForm(Family.FASTESTDET, 80))
    assert (values[0, 2] == 1).all() and placement.scale == (64 / 120, 64 / 60) and placement.offset == (0, 0)


def test_boxes_come_back_to_the_image_cut_at_its_edges() -> None:
    # In the network's pixels; the image's rows are 16 to 48.
    found = detector([(0, [32, 32, 16, 8, 0, 0, 0.6]), (9, [60, 44, 16, 16, 0.9])]).detect(WIDE)
    assert found.scores == pytest.approx([0.9, 0.6]) and found.classes.tolist() == [0, 2] and found.masks is None
    scale = 120 / 64
    assert found.boxes[1] == pytest.approx([24 * scale, 12 * scale, 40 * scale, 20 * scale], abs=1e-3)
    assert found.boxes[0] == pytest.approx([52 * scale, 20 * scale, 120, 60], abs=1e-3)


def test_a_box_in_the_margin_is_no_detection() -> None:
    assert len(detector([(0, [32, 6, 16, 8, 0.9])]).detect(WIDE)) == 0
    assert detector([]).detect(WIDE).boxes.shape == (0, 4)


def test_of_overlapping_boxes_of_a_class_the_best_stays() -> None:
    boxes = [(0, [32, 32, 20, 20, 0, 0, 0.6]), (1, [33, 32, 20, 20, 0, 0, 0.8]), (2, [32, 32, 20, 20, 0.7])]
    found = detector(boxes).detect(np.zeros((64, 64, 3), np.uint8))
    assert found.classes.tolist() == [2, 0] and found.scores == pytest.approx([0.8, 0.7])
    apart = np.array([[0, 0, 10, 10], [6, 0, 16, 10], [3, 0, 13, 10]], np.float32)  # overlaps 0.25, 0.54, 0.54
    kept = suppress_overlaps(apart, np.array([0.5, 0.6, 0.4], np.float32), np.zeros(3, np.int64))
    assert kept.tolist() == [1, 0]


def test_masks_are_sums_of_prototypes_inside_the_box() -> None:
    prototypes = np.full((1, 2, 16, 16), -1, np.float32)
    prototypes[0, 0, :, 8:] = 1  # the right half
    prototypes[0, 1, 8:] = 1  # the lower half
    right = [32, 32, 32, 16, 0.9, 5, 0]
    lower = [16, 36, 16, 8, 0.8, 0, 5]
    rows = yolov8_rows(SIZE, [(0, right), (1, lower)], 3)
    network = FakeNetwork(SIZE, [prototypes, rows], {"names": "{0: 'car'}"})
    found = YoloDetector.from_network(network, FILE).detect(WIDE)
    assert found.masks is not None and found.masks.shape == (2, 60, 120) and found.masks.dtype == bool
    expected = np.zeros((2, 60, 120), bool)
    expected[0, 15:45, 60:90] = True  # the box is [30, 90] × [15, 45] of the image, its right half from 60 on
    expected[1, 30:45, 15:45] = True  # the box is [15, 45] × [30, 45], wholly in the lower half
    assert (found.masks == expected).mean(axis=(1, 2)) == pytest.approx(1, abs=0.005)
    assert not (found.masks[0][:, :59]).any() and not found.masks[0][:, 91:].any()


def test_masks_of_no_detection_are_an_empty_array() -> None:
    network = FakeNetwork(SIZE, [yolov8_rows(SIZE, [], 3), np.zeros((1, 2, 16, 16), np.float32)], {"names": "['car']"})
    found = YoloDetector.from_network(network, FILE).detect(WIDE)
    assert found.masks is not None and found.masks.shape == (0, 60, 120)


def test_names_are_coco_s_or_those_in_the_file() -> None:
    network = FakeNetwork((64, 96), [yolov8_rows((64, 96), [], 80)])
    assert YoloDetector.from_network(network, FILE).class_names == COCO_CLASSES and len(set(COCO_CLASSES)) == 80
    assert detector([], ("car", "tram")).class_names == ("car", "tram")
    assert find_stored_names({"names": "{1: 'tram', 0: 'car'}"}) == ("car", "tram")
    assert find_stored_names({"metadata.json": '{"task": "detect", "names": {"0": "car"}}'}) == ("car",)
    assert find_stored_names({"names": "no literal", "stride": "32"}) is None
    assert find_road_users(COCO_CLASSES) == (0, 1, 2, 3, 5, 7)


def test_a_list_of_another_length_is_refused(tmp_path: Path) -> None:
    rows = yolov8_rows(SIZE, [], 3)
    with pytest.raises(InputError, match=r"has 3 classes, and COCO's list of class names has 80.*x\.onnx"):
        YoloDetector.from_network(FakeNetwork(SIZE, [rows]), FILE)
    with pytest.raises(InputError, match=r"has 3 classes, and the file's list of class names has 1"):
        YoloDetector.from_network(FakeNetwork(SIZE, [rows], {"names": "['car']"}), FILE)
    names = tmp_path / "names.txt"
    names.write_text("car\ntram\n\n")
    with pytest.raises(InputError, match=r"has 3 classes, and the list .*names\.txt has 2"):
        YoloDetector.from_network(FakeNetwork(SIZE, [rows]), FILE, names)
    opened = YoloDetector.from_network(FakeNetwork(SIZE, [yolov8_rows(SIZE, [], 2)]), FILE, names)
    assert opened.class_names == ("car", "tram")
    for text, problem in (("\n", "is empty"), (None, "cannot be read")):
        names.unlink()
        if text is not None:
            names.write_text(text)
        else:
            names.mkdir()
        with pytest.raises(InputError, match=problem):
            YoloDetector.from_network(FakeNetwork(SIZE, [yolov8_rows(SIZE, [], 2)]), FILE, names)


def test_a_class_number_without_a_name_is_refused(tmp_path: Path) -> None:
    rows = np.zeros((1, 300, 6), np.float32)
    rows[0, 0] = (5, 5, 30, 30, 0.9, 80)
    with pytest.raises(InputError, match=r"gives class 80, and the list of class names has 80"):
        YoloDetector.from_network(FakeNetwork(SIZE, [rows]), FILE).detect(WIDE)


def test_outputs_of_no_family_are_refused_with_their_shapes() -> None:
    with pytest.raises(
        InputError, match=r"gives \[\[1, 1000\]\] for an image of 64 × 64.*x\.onnx.*FastestDet.*YOLOv10"
    ):
        YoloDetector.from_network(FakeNetwork(SIZE, [np.zeros((1, 1000), np.float32)]), FILE)


def test_drawing_frames_boxes_and_tints_masks_in_the_class_s_colour() -> None:
    image = np.full((120, 200, 3), 100, np.uint8)
    masks = np.zeros((2, 120, 200), bool)
    masks[0, 60:80, 40:60] = True
    boxes = np.array([[40, 60, 60, 80], [120, 0, 199, 119]], np.float32)
    found = Detections(boxes, np.array([0.9, 0.5], np.float32), np.array([2, 7]), masks)
    drawn = draw_detections(image, found, COCO_CLASSES)
    car = np.array(choose_color(2))
    assert (image == 100).all() and drawn.shape == image.shape and drawn.dtype == np.uint8
    assert drawn[79, 50].tolist() == car.tolist() and drawn[119 - 1, 150].tolist() == list(choose_color(7))
    assert drawn[70, 50].tolist() == pytest.approx((50 + car / 2).tolist(), abs=1)
    assert (drawn[100, 20] == 100).all() and (drawn[60, 130] == 100).all()
    label = drawn[48:60, 40:100].reshape(-1, 3)  # text, black on the colour, above the box
    assert (label == car).all(1).any() and (label.max(1) < 100).any()
    assert len({choose_color(number) for number in find_road_users(COCO_CLASSES)}) == 6
    nothing = Detections(np.zeros((0, 4), np.float32), np.zeros(0, np.float32), np.zeros(0, np.int64))
    assert (draw_detections(image, nothing, COCO_CLASSES) == image).all()
