"""Boxes, scores and classes from what networks of the supported families give."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from genre_tasks.detection.output_forms import STRIDES, Family, OutputForm
from genre_tasks.detection.suppression import Candidates
from genre_tasks.logs.types import Float32

FRACTION_LIMIT = 2.0
"""Boxes are fractions of the input where none of all cells' values is larger: in pixels, the last cells' are."""


def decode_output(form: OutputForm, output: Float32, input_size: tuple[int, int], min_score: float) -> Candidates:
    """Decodes a network's output.

    Args:
        form: as :func:`genre_tasks.detection.output_forms.recognise_form` has found it.
        output: the rows or the map of boxes, without the batch's axis.
        input_size: height and width of the network's input.
        min_score: candidates with a lower score are left out.

    Returns:
        The candidates, with boxes in pixels of the input.
    """
    if form.family is Family.FASTESTDET:
        return decode_fastestdet(output, input_size, min_score)
    if form.family is Family.YOLOX:
        return decode_yolox(output, input_size, min_score)
    if form.family is Family.YOLOV5:
        return decode_yolov5(output, input_size, min_score, form.mask_channels)
    if form.family is Family.YOLOV8:
        return decode_yolov8(output, input_size, min_score, form.mask_channels)
    return decode_end_to_end(output, input_size, min_score)


def decode_fastestdet(output: Float32, input_size: tuple[int, int], min_score: float) -> Candidates:
    """Decodes FastestDet's output.

    Each cell holds objectness, the offset of the centre before tanh, width and height before the sigmoid, and a score
    for each class.

    Args:
        output: [5 + K, rows, columns].
        input_size: height and width of the network's input.
        min_score: candidates with a lower score are left out.

    Returns:
        The candidates, with boxes in pixels of the input.
    """
    cells = output[:5].astype(np.float64)
    classes = output[5:].astype(np.float64)
    # FastestDet weighs objectness and class like this.
    score = cells[0].clip(0) ** 0.6 * classes.max(0).clip(0) ** 0.4
    row, column = np.nonzero(score >= min_score)
    _, dx, dy, width, height = cells[:, row, column]
    grid = np.array([output.shape[2], output.shape[1]])[:, None]
    centre = (np.stack([column, row]) + np.tanh([dx, dy])) / grid
    half_size = 0.5 * _sigmoid(np.stack([width, height]))
    fractions = np.concatenate([centre - half_size, centre + half_size]).T
    boxes = fractions * np.array([input_size[1], input_size[0]] * 2)
    return _gather(boxes, score[row, column], classes[:, row, column].argmax(0))


def decode_yolox(output: Float32, input_size: tuple[int, int], min_score: float) -> Candidates:
    """Decodes YOLOX's output, with boxes relative to their cells, or in pixels where the file decodes them.

    Args:
        output: [N, 5 + K] centre, logarithm of width and height, objectness, and a score for each class.
        input_size: height and width of the network's input.
        min_score: candidates with a lower score are left out.

    Returns:
        The candidates, with boxes in pixels of the input.
    """
    # Only the best class of a cell: a second one would be a second box in the same place.
    score = output[:, 4] * output[:, 5:].max(1)
    good = score >= min_score
    centre = output[good, :2].astype(np.float64)
    size = output[good, 2:4].astype(np.float64)
    # In pixels, the last columns' centres are near the right edge; relative to a cell, none is so far away from it.
    if output[:, 0].max() < input_size[1] / 2:
        corner, stride = _list_cells(input_size)
        centre = (centre + corner[good]) * stride[good]
        size = np.exp(size) * stride[good]
    return _gather(_corners(centre, size), score[good], output[good, 5:].argmax(1))


def decode_yolov5(output: Float32, input_size: tuple[int, int], min_score: float, mask_channels: int = 0) -> Candidates:
    """Decodes YOLOv5's output.

    Args:
        output: [3N, 5 + K + C] centre, width and height in pixels or as fractions, objectness, a score for each
            class, and the masks' coefficients.
        input_size: height and width of the network's input.
        min_score: candidates with a lower score are left out.
        mask_channels: number C of coefficients.

    Returns:
        The candidates, with boxes in pixels of the input.
    """
    # Coefficients are no scores: as classes they would win everywhere.
    end = output.shape[1] - mask_channels
    score = output[:, 4] * output[:, 5:end].max(1)
    good = score >= min_score
    boxes = _corners(output[good, :2], output[good, 2:4]) * _find_unit(output[:, :4], input_size)
    return _gather(boxes, score[good], output[good, 5:end].argmax(1), output[good, end:])


def decode_yolov8(output: Float32, input_size: tuple[int, int], min_score: float, mask_channels: int = 0) -> Candidates:
    """Decodes the output of YOLOv8 and YOLO11.

    Args:
        output: [4 + K + C, N] centre, width and height in pixels or as fractions, a score for each class, and the
            masks' coefficients.
        input_size: height and width of the network's input.
        min_score: candidates with a lower score are left out.
        mask_channels: number C of coefficients.

    Returns:
        The candidates, with boxes in pixels of the input.
    """
    end = output.shape[0] - mask_channels
    score = output[4:end].max(0)
    good = score >= min_score
    rows = output[:, good].T
    # The unit is found from all cells, since the boxes of one image can all be small.
    boxes = _corners(rows[:, :2], rows[:, 2:4]) * _find_unit(output[:4].T, input_size)
    return _gather(boxes, score[good], rows[:, 4:end].argmax(1), rows[:, end:])


def decode_end_to_end(output: Float32, input_size: tuple[int, int], min_score: float) -> Candidates:
    """Decodes the output of networks that choose their boxes themselves, such as YOLOv10.

    Args:
        output: [M, 6 + C] corners in pixels or as fractions, score, number of the class, and the masks' coefficients.
        input_size: height and width of the network's input.
        min_score: candidates with a lower score are left out.

    Returns:
        The candidates, with boxes in pixels of the input.
    """
    # Rows without a box are zeros, whose score is below any but 0.
    rows = output[output[:, 4] >= min_score]
    boxes = rows[:, :4] * _find_unit(output[:, :4], input_size)
    return _gather(boxes, rows[:, 4], rows[:, 5].round(), rows[:, 6:])


def _sigmoid(values: NDArray[np.float64]) -> NDArray[np.float64]:
    """The logistic function."""
    result: NDArray[np.float64] = 1 / (1 + np.exp(-values))
    return result


def _corners(centre: NDArray[np.floating], size: NDArray[np.floating]) -> NDArray[np.floating]:
    """[M, 4] corners of boxes."""
    return np.concatenate([centre - size / 2, centre + size / 2], 1)


def _find_unit(values: Float32, input_size: tuple[int, int]) -> Float32:
    """[4] by what boxes are multiplied to be in pixels: 1, or the input's size where they are fractions of it."""
    # Exports to TFLite divide by the size, so that boxes survive being stored in 8 bits.
    fractions = not len(values) or float(values.max()) <= FRACTION_LIMIT
    return np.array([input_size[1], input_size[0]] * 2 if fractions else [1] * 4, np.float32)


def _list_cells(input_size: tuple[int, int]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """[N, 2] column and row of every cell, the smallest cells first, and [N, 1] their width in pixels."""
    corners: list[NDArray[np.int64]] = []
    strides: list[NDArray[np.float64]] = []
    for stride in STRIDES:
        row, column = np.mgrid[: input_size[0] // stride, : input_size[1] // stride]
        corners.append(np.stack([column.ravel(), row.ravel()], 1))
        strides.append(np.full((row.size, 1), float(stride)))
    return np.concatenate(corners).astype(np.float64), np.concatenate(strides)


def _gather(
    boxes: NDArray[np.floating],
    scores: NDArray[np.floating],
    classes: NDArray[np.int64] | NDArray[np.floating],
    coefficients: Float32 | None = None,
) -> Candidates:
    """Candidates of the right types."""
    empty = np.zeros((len(scores), 0), np.float32)
    return Candidates(
        boxes.astype(np.float32),
        # Scores stored in 8 bits can be a step above 1.
        scores.clip(0, 1).astype(np.float32),
        classes.astype(np.int64),
        empty if coefficients is None else coefficients.astype(np.float32),
    )
