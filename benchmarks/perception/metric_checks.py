"""Whether the numbers are those of the evaluations that they are named after."""

from __future__ import annotations

import contextlib
import io
from collections.abc import Iterator, Sequence

import numpy as np

from benchmarks.common.bench import NotMeasuredError, Row
from benchmarks.common.claims import Claim, claim
from genre_tasks.detection.agreement import average_precision, match_image
from genre_tasks.detection.detections import Detections

MOST_DIFFERENCE = 1e-6
_SETS = 20
_IMAGES = 12


def measure_metrics() -> Row:
    """Compares average precision with pycocotools on random boxes.

    Returns:
        ``largest_difference`` over the sets.

    Raises:
        NotMeasuredError: pycocotools is not installed.
    """
    try:
        import pycocotools.coco  # noqa: F401
    except ImportError:
        raise NotMeasuredError("pycocotools is not installed") from None
    differences = []
    for seed in range(_SETS):
        random = np.random.default_rng(seed)
        reference = [_draw_boxes(random, 8) for _ in range(_IMAGES)]
        found = [_disturb(random, boxes) for boxes in reference]
        # One class, whose average precision is then that of the whole evaluation.
        matches = [match_image(r, f)[0] for r, f in zip(reference, found, strict=True)]
        differences.append(abs(average_precision(matches) - _evaluate_by_coco(reference, found)))
    return {"kind": "metrics", "sets": _SETS, "largest_difference": max(differences)}


def _draw_boxes(random: np.random.Generator, count: int) -> Detections:
    corners = random.uniform(0, 60, (count, 2))
    boxes = np.concatenate([corners, corners + random.uniform(4, 40, (count, 2))], 1).astype(np.float32)
    return Detections(boxes, random.uniform(0.3, 1, count).astype(np.float32), np.zeros(count, np.int64))


def _disturb(random: np.random.Generator, reference: Detections) -> Detections:
    near = reference.select(random.random(len(reference)) < 0.8)
    boxes = near.boxes + random.normal(0, 2, near.boxes.shape).astype(np.float32)
    # A box that noise turned inside out has no area, and COCO's evaluation leaves it out.
    boxes[:, 2:] = np.maximum(boxes[:, 2:], boxes[:, :2] + 1)
    extra = _draw_boxes(random, 3)
    scores = random.uniform(0.3, 1, len(near) + 3).astype(np.float32)
    return Detections(np.concatenate([boxes, extra.boxes]), scores, np.zeros(len(scores), np.int64))


def _evaluate_by_coco(reference: Sequence[Detections], found: Sequence[Detections]) -> float:
    from pycocotools.coco import COCO
    from pycocotools.cocoeval import COCOeval

    def rows(sets: Sequence[Detections]) -> list[dict[str, object]]:
        out: list[dict[str, object]] = []
        for image, detections in enumerate(sets):
            for box, score in zip(detections.boxes.tolist(), detections.scores.tolist(), strict=True):
                width, height = box[2] - box[0], box[3] - box[1]
                place = {"image_id": image + 1, "category_id": 1, "bbox": [box[0], box[1], width, height]}
                out.append(place | {"area": width * height, "iscrowd": 0, "score": score, "id": len(out) + 1})
        return out

    truth = COCO()
    truth.dataset = {
        "images": [{"id": n + 1, "height": 128, "width": 128} for n in range(len(reference))],
        "categories": [{"id": 1, "name": "car"}],
        "annotations": rows(reference),
    }
    with contextlib.redirect_stdout(io.StringIO()):
        truth.createIndex()
        evaluation = COCOeval(truth, truth.loadRes(rows(found)), "bbox")
        # COCO averages over overlaps from 0.5 to 0.95; the paper's table has one number.
        evaluation.params.iouThrs = np.array([0.5])
        evaluation.evaluate()
        evaluation.accumulate()
    return float(evaluation.eval["precision"][0, :, 0, 0, 2].mean())


def metric_claims(rows: Sequence[Row]) -> Iterator[Claim]:
    """Claims that average precision is that of pycocotools.

    Args:
        rows: see :func:`measure_metrics`.
    """
    if not rows:
        yield claim("perception.metric_difference", None, "<=", MOST_DIFFERENCE, "AP", "not measured")
    for row in rows:
        note = f"average precision less that of pycocotools, the largest of {row['sets']} sets of random boxes"
        yield claim(
            "perception.metric_difference", row["largest_difference"], "<=", MOST_DIFFERENCE, "AP", note, row["sets"]
        )
