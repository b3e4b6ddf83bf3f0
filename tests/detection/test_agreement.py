"""How far finds agree: against COCO's own evaluation, and on cases that can be counted by hand."""

from __future__ import annotations

import contextlib
import io
import math

import numpy as np
import pytest
from numpy.typing import NDArray

from genre_tasks.detection.agreement import (
    Agreement,
    average_precision,
    box_overlaps,
    compare_detections,
    match_image,
    resample_images,
    summarise_matches,
)
from genre_tasks.detection.detections import Detections

CLASSES = 3


def make_detections(random: np.random.Generator, count: int) -> Detections:
    corners = random.uniform(0, 60, (count, 2))
    boxes = np.concatenate([corners, corners + random.uniform(4, 40, (count, 2))], 1).astype(np.float32)
    scores = np.sort(random.uniform(0.3, 1, count).astype(np.float32))[::-1].copy()
    return Detections(boxes, scores, random.integers(0, CLASSES, count))


def disturb(random: np.random.Generator, detections: Detections) -> Detections:
    kept = random.random(len(detections)) < 0.8
    near = detections.select(kept)
    boxes = near.boxes + random.normal(0, 2, near.boxes.shape).astype(np.float32)
    # A box that noise turned inside out has no area, and COCO's evaluation leaves it out.
    boxes[:, 2:] = np.maximum(boxes[:, 2:], boxes[:, :2] + 1)
    extra = make_detections(random, 3)
    scores = random.uniform(0.3, 1, len(near) + 3).astype(np.float32)
    return Detections(np.concatenate([boxes, extra.boxes]), scores, np.concatenate([near.classes, extra.classes]))


def add_masks(detections: Detections, size: int = 128) -> Detections:
    masks = np.zeros((len(detections), size, size), bool)
    for mask, (left, top, right, bottom) in zip(masks, detections.boxes.round().astype(int), strict=True):
        mask[max(top, 0) : bottom, max(left, 0) : right] = True
    return Detections(detections.boxes, detections.scores, detections.classes, masks)


def evaluate_by_coco(reference: list[Detections], found: list[Detections], kind: str) -> tuple[list[float], float]:
    """Average precision of each class at an overlap of 0.5, and the recall over all, as pycocotools gives them."""
    from pycocotools import mask as mask_tools
    from pycocotools.coco import COCO
    from pycocotools.cocoeval import COCOeval

    def shape(detections: Detections, k: int) -> dict[str, object]:
        left, top, right, bottom = map(float, detections.boxes[k])
        shapes: dict[str, object] = {"bbox": [left, top, right - left, bottom - top]}
        shapes["area"] = (right - left) * (bottom - top)
        if detections.masks is not None:
            shapes["segmentation"] = mask_tools.encode(np.asfortranarray(detections.masks[k].astype(np.uint8)))
        return shapes

    def rows(sets: list[Detections]) -> list[dict[str, object]]:
        return [
            {"image_id": i + 1, "category_id": int(d.classes[k]) + 1, "iscrowd": 0, "score": float(d.scores[k])}
            | shape(d, k)
            for i, d in enumerate(sets)
            for k in range(len(d))
        ]

    truth = COCO()
    truth.dataset = {
        "images": [{"id": i + 1, "height": 128, "width": 128} for i in range(len(reference))],
        "categories": [{"id": c + 1, "name": str(c)} for c in range(CLASSES)],
        "annotations": [row | {"id": n + 1} for n, row in enumerate(rows(reference))],
    }
    with contextlib.redirect_stdout(io.StringIO()):
        truth.createIndex()
        evaluation = COCOeval(truth, truth.loadRes(rows(found)), kind)
        evaluation.params.iouThrs = np.array([0.5])
        evaluation.evaluate()
        evaluation.accumulate()
    by_class = evaluation.eval["precision"][0, :, :, 0, 2].mean(0)
    counts = np.array([sum(int((d.classes == c).sum()) for d in reference) for c in range(CLASSES)])
    recall = evaluation.eval["recall"][0, :, 0, 2]
    return by_class.tolist(), float((recall * counts).sum() / counts.sum())


@pytest.mark.parametrize("seed", range(6))
@pytest.mark.parametrize("kind", ["bbox", "segm"])
def test_average_precision_and_recall_are_those_of_pycocotools(seed: int, kind: str) -> None:
    random = np.random.default_rng(seed)
    reference = [add_masks(make_detections(random, 8)) for _ in range(7)]
    found = [add_masks(disturb(random, d)) for d in reference]
    of_masks = kind == "segm"
    by_class, recall = evaluate_by_coco(reference, found, kind)
    matches = [match_image(r, f, of_masks=of_masks) for r, f in zip(reference, found, strict=True)]
    for name, expected in enumerate(by_class):
        ours = average_precision([image[name] for image in matches if name in image])
        assert ours == pytest.approx(expected, abs=1e-6)
    agreement = compare_detections(reference, found, of_masks=of_masks)
    assert agreement.recall == pytest.approx(recall, abs=1e-6)
    counts = [sum(int((d.classes == c).sum()) for d in reference) for c in range(CLASSES)]
    assert agreement.average_precision == pytest.approx(np.average(by_class, weights=counts), abs=1e-6)


def one_box(left: float, score: float = 0.9, name: int = 2) -> Detections:
    box = np.array([[left, 0, left + 10, 10]], np.float32)
    return Detections(box, np.array([score], np.float32), np.array([name]))


def test_an_object_that_moved_by_a_quarter_still_agrees() -> None:
    agreement = compare_detections([one_box(0)], [one_box(2.5)])
    assert agreement == Agreement(1.0, 1.0, pytest.approx(0.6), pytest.approx(0.6), 1)


def test_another_class_is_no_match() -> None:
    agreement = compare_detections([one_box(0)], [one_box(0, name=7)])
    assert (agreement.average_precision, agreement.recall, agreement.mean_overlap) == (0, 0, 0)
    assert math.isnan(agreement.matched_overlap)


def test_a_second_find_of_one_object_does_not_count_as_found() -> None:
    twice = Detections(
        np.array([[0, 0, 10, 10], [0, 0, 10, 9]], np.float32), np.array([0.9, 0.8], np.float32), np.array([2, 2])
    )
    (matches,) = match_image(one_box(0), twice).values()
    assert matches.matched.tolist() == [True, False]


def test_classes_that_do_not_count_are_left_out() -> None:
    assert compare_detections([one_box(0), one_box(0, name=5)], [one_box(0)] * 2, classes=(2,)).instances == 1


def test_without_instances_there_is_no_number() -> None:
    nothing = one_box(0).select(np.zeros(1, bool))
    agreement = compare_detections([nothing], [one_box(0)])
    assert agreement.instances == 0
    assert math.isnan(agreement.recall)


def test_boxes_alone_have_no_mask_agreement() -> None:
    with pytest.raises(ValueError, match="masks"):
        compare_detections([one_box(0)], [one_box(0)], of_masks=True)


def test_overlaps_of_empty_boxes_are_zero() -> None:
    empty: NDArray[np.float32] = np.zeros((1, 4), np.float32)
    assert box_overlaps(empty, empty).tolist() == [[0.0]]


def test_an_interval_of_a_difference_excludes_zero_where_one_method_is_better_everywhere() -> None:
    random = np.random.default_rng(0)
    reference = [make_detections(random, 6) for _ in range(12)]
    good = [match_image(r, r) for r in reference]
    bad = [match_image(r, r.select(random.random(len(r)) < 0.5)) for r in reference]
    low, high = resample_images([good, bad], lambda both: both[0].recall - both[1].recall, resamples=200)
    assert 0.2 < low < summarise_matches(good).recall - summarise_matches(bad).recall < high
