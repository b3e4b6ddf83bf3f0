"""What networks of each family give, decoded and compared with boxes that were computed by hand."""

from __future__ import annotations

import math

import numpy as np
import pytest

from genre_tasks.detection.decoding import (
    decode_end_to_end,
    decode_fastestdet,
    decode_yolov5,
    decode_yolov8,
    decode_yolox,
)
from genre_tasks.detection.output_forms import Family, Fit, OutputForm, count_cells, recognise_form

SIZE = (64, 96)
CELLS = 8 * 12 + 4 * 6 + 2 * 3


@pytest.mark.parametrize(
    "size,shapes,family,classes,masks",
    [
        ((352, 352), [(1, 85, 22, 22)], Family.FASTESTDET, 80, 0),
        ((416, 416), [(1, 3549, 85)], Family.YOLOX, 80, 0),
        ((640, 640), [(1, 25200, 85)], Family.YOLOV5, 80, 0),
        ((640, 640), [(1, 25200, 8)], Family.YOLOV5, 3, 0),
        ((640, 640), [(1, 84, 8400)], Family.YOLOV8, 80, 0),
        ((640, 640), [(1, 32, 160, 160), (1, 116, 8400)], Family.YOLOV8, 80, 32),
        ((640, 640), [(1, 25200, 117), (1, 32, 160, 160)], Family.YOLOV5, 80, 32),
        ((640, 640), [(1, 300, 6)], Family.END_TO_END, None, 0),
        (SIZE, [(1, 5, CELLS)], Family.YOLOV8, 1, 0),
    ],
)
def test_a_family_is_recognised_by_its_shapes(
    size: tuple[int, int], shapes: list[tuple[int, ...]], family: Family, classes: int | None, masks: int
) -> None:
    assert recognise_form(size, shapes) == OutputForm(family, classes, masks)


@pytest.mark.parametrize(
    "size,shapes",
    [
        ((224, 224), [(1, 1000)]),  # a classifier
        ((640, 640), [(1, 255, 80, 80), (1, 255, 40, 40), (1, 255, 20, 20)]),  # grids that are not decoded
        ((640, 640), [(1, 84, 8399)]),
        ((640, 640), [(2, 84, 8400)]),
        ((640, 640), [(1, 84, 8400), (1, 32, 80, 80)]),
        ((352, 352), [(1, 85, 11, 11)]),
        ((640, 640), []),
    ],
)
def test_other_shapes_are_of_no_family(size: tuple[int, int], shapes: list[tuple[int, ...]]) -> None:
    assert recognise_form(size, shapes) is None


def test_families_take_images_as_in_their_training() -> None:
    taken = {family: (OutputForm(family, 80).blue_first, OutputForm(family, 80).divisor) for family in Family}
    assert taken[Family.FASTESTDET] == (True, 255) and taken[Family.YOLOX] == (True, 1)
    assert {taken[f] for f in (Family.YOLOV5, Family.YOLOV8, Family.END_TO_END)} == {(False, 255)}
    assert OutputForm(Family.YOLOX, 80).fit is Fit.CORNER and OutputForm(Family.YOLOV8, 80).fit is Fit.CENTRED


def test_fastestdet_boxes_are_offsets_from_their_cells() -> None:
    output = np.zeros((5 + 3, 4, 6), np.float32)
    cell = output[:, 2, 1]
    cell[0], cell[5:] = 0.81, (0.1, 0.9, 0.2)
    cell[1:3] = np.arctanh([0.5, -0.25])
    cell[3:5] = [math.log(s / (1 - s)) for s in (0.25, 0.5)]
    found = decode_fastestdet(output, SIZE, 0.5)
    centre = (1.5 / 6 * 96, 1.75 / 4 * 64)
    assert found.boxes[0] == pytest.approx([centre[0] - 12, centre[1] - 16, centre[0] + 12, centre[1] + 16], abs=1e-3)
    assert found.classes.tolist() == [1] and found.scores[0] == pytest.approx(0.81**0.6 * 0.9**0.4)
    assert len(decode_fastestdet(output, SIZE, 0.9).scores) == 0


@pytest.mark.parametrize("in_pixels", [False, True])
def test_yolox_boxes_are_relative_to_their_cells_or_in_pixels(in_pixels: bool) -> None:
    output = np.zeros((CELLS, 5 + 2), np.float32)
    # The second cell of the third row of stride 8, and the last cell of stride 16.
    cells = (2 * 12 + 1, 8 * 12 + 4 * 6 - 1)
    output[cells[0]] = (0.5, 0.25, math.log(2), math.log(3), 0.8, 0.1, 0.9)
    output[cells[1]] = (0.5, 0.5, math.log(1.5), 0, 0.5, 0.8, 0.3)
    if in_pixels:
        output[cells[0], :4] = (12, 18, 16, 24)
        output[cells[1], :4] = (88, 56, 24, 16)
    found = decode_yolox(output, SIZE, 0.3)
    assert found.boxes == pytest.approx(np.array([[4, 6, 20, 30], [76, 48, 100, 64]]), abs=1e-4)
    assert found.scores == pytest.approx([0.72, 0.4]) and found.classes.tolist() == [1, 0]


@pytest.mark.parametrize("unit", [1.0, 0.0])
def test_yolov5_boxes_are_in_pixels_or_fractions(unit: float) -> None:
    output = np.zeros((3 * CELLS, 5 + 2 + 3), np.float32)
    output[-1, :4] = (80, 48, 30, 30)
    output[7] = (20, 30, 10, 40, 0.9, 0.2, 0.8, 1, 2, 3)
    if not unit:
        output[:, :4] /= np.array([96, 64, 96, 64], np.float32)
    found = decode_yolov5(output, SIZE, 0.5, mask_channels=3)
    assert found.boxes == pytest.approx(np.array([[15, 10, 25, 50]]), abs=1e-4)
    assert found.scores == pytest.approx([0.72]) and found.classes.tolist() == [1]
    assert found.coefficients.tolist() == [[1, 2, 3]]


@pytest.mark.parametrize("unit", [1.0, 0.0])
def test_yolov8_boxes_are_in_pixels_or_fractions(unit: float) -> None:
    output = np.zeros((4 + 2 + 1, CELLS), np.float32)
    output[:4, -1] = (80, 48, 30, 30)
    output[:, 5] = (20, 30, 10, 40, 0.2, 0.8, -7)
    if not unit:
        output[:4] /= np.array([[96], [64], [96], [64]], np.float32)
    found = decode_yolov8(output, SIZE, 0.5, mask_channels=1)
    assert found.boxes == pytest.approx(np.array([[15, 10, 25, 50]]), abs=1e-4)
    assert found.scores == pytest.approx([0.8]) and found.classes.tolist() == [1]
    assert found.coefficients.tolist() == [[-7]]


def test_boxes_that_a_network_has_chosen_itself_are_taken_as_they_are() -> None:
    output = np.zeros((300, 6), np.float32)
    output[:2] = ((10, 20, 40, 60, 0.9, 7), (11, 20, 40, 60, 0.2, 2))
    found = decode_end_to_end(output, SIZE, 0.3)
    assert found.boxes.tolist() == [[10, 20, 40, 60]] and found.classes.tolist() == [7]
    assert len(decode_end_to_end(np.zeros((300, 6), np.float32), SIZE, 0.3).scores) == 0


def test_cells_are_counted_of_images_that_are_no_squares() -> None:
    assert count_cells(SIZE) == CELLS
