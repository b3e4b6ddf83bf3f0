"""Average precision by centre distance: the devkit's published examples, and a second computation from scratch."""

from __future__ import annotations

import math

import numpy as np
import pytest

from genre_tasks.detection3d.average_precision import (
    Centres,
    ClassScores,
    DetectionScores,
    average_precision,
    interpolate_precision,
    match_detections,
    score_class,
)
from genre_tasks.errors import InputError

# From nuScenes' devkit, python-sdk/nuscenes/eval/detection/tests/test_algo.py, version 1.2.0: samples and positions of
# true boxes, the same with scores of detections, and the average precision to 0.01 at 2 m.
CAR1 = (1.0, 1.0)
CAR2 = (3.0, 3.0)
PUBLISHED = {
    "no truth": ([], [(0, CAR1, 1.0)], 0.0),
    "nothing found": ([(0, CAR1)], [], 0.0),
    "neither": ([], [], 0.0),
    "perfect": ([(0, CAR1)], [(0, CAR1, 1.0)], 1.0),
    "one of two": ([(0, CAR1), (0, CAR2)], [(0, CAR1, 1.0)], 0.4 / 0.9),
    "a false one after": ([(0, CAR1)], [(0, CAR1, 1.0), (0, CAR2, 0.7)], 1.0),
    "a false one before": ([(0, CAR2)], [(0, CAR1, 1.0), (0, CAR2, 0.7)], ((0.8 * 0.4) / 2) / (0.9 * 0.9)),
    "two samples": ([(0, CAR1), (1, CAR2)], [(0, CAR1, 1.0), (1, CAR2, 0.7)], 1.0),
    "one of two samples": ([(0, CAR1), (1, CAR2)], [(0, CAR1, 1.0)], 0.4 / 0.9),
}


def centres(samples: list[int], positions: list[tuple[float, float]]) -> Centres:
    return Centres(np.array(samples, np.int64), np.array(positions, np.float64).reshape(-1, 2))


@pytest.mark.parametrize("name", PUBLISHED)
def test_published_examples(name: str) -> None:
    true, found, expected = PUBLISHED[name]
    scores = score_class(
        "car",
        centres([sample for sample, _ in true], [place for _, place in true]),
        centres([sample for sample, _, _ in found], [place for _, place, _ in found]),
        np.array([score for _, _, score in found]),
        (2.0,),
    )
    assert scores.average_precisions[2.0] == pytest.approx(expected, abs=0.01)


def compute_slowly(
    true: list[tuple[int, float, float]], found: list[tuple[int, float, float, float]], threshold: float
) -> float:
    """The definition in plain Python: no shared code, no arrays."""
    taken: set[int] = set()
    curve = []
    right = 0
    ordered = sorted(enumerate(found), key=lambda item: (item[1][3], item[0]), reverse=True)
    for rank, (_, (sample, x, z, _)) in enumerate(ordered, start=1):
        options = [
            (math.hypot(x - tx, z - tz), n) for n, (ts, tx, tz) in enumerate(true) if ts == sample and n not in taken
        ]
        if options and min(options)[0] < threshold:
            taken.add(min(options)[1])
            right += 1
        curve.append((right / len(true), right / rank))
    if not curve:
        return 0.0
    if curve[0][0] > 0:
        curve.insert(0, (0.0, curve[0][1]))
    total = 0.0
    for step in range(11, 101):
        recall = np.linspace(0, 1, 101)[step]
        # Of several points of the same recall the last one: that is how the benchmark's interpolation reads it.
        before = [n for n, point in enumerate(curve) if point[0] <= recall]
        if recall > curve[-1][0]:
            continue
        n = before[-1]
        precision = curve[n][1]
        if n + 1 < len(curve):
            share = (recall - curve[n][0]) / (curve[n + 1][0] - curve[n][0])
            precision += share * (curve[n + 1][1] - curve[n][1])
        total += max(precision - 0.1, 0.0)
    return total / 90 / 0.9


@pytest.mark.parametrize("seed", range(12))
def test_equals_a_computation_from_scratch(seed: int) -> None:
    rng = np.random.default_rng(seed)
    true = [(int(rng.integers(6)), *rng.uniform(0, 12, 2)) for _ in range(int(rng.integers(1, 25)))]
    found = [(s, x + rng.normal(0, 0.9), z + rng.normal(0, 0.9), rng.random()) for s, x, z in true[::2]]
    # Rounded scores: some are equal.
    found += [(int(rng.integers(6)), *rng.uniform(0, 12, 2), round(rng.random(), 1)) for _ in range(20)]
    scores = score_class(
        "car",
        centres([t[0] for t in true], [t[1:] for t in true]),
        centres([f[0] for f in found], [f[1:3] for f in found]),
        np.array([f[3] for f in found]),
        (0.5, 1.0, 2.0, 4.0),
    )
    for threshold, value in scores.average_precisions.items():
        assert value == pytest.approx(compute_slowly(true, found, threshold), abs=1e-9)
    assert max(scores.average_precisions.values()) > 0


def test_a_box_is_matched_once_and_by_the_better_score() -> None:
    true = centres([0], [(0.0, 10.0)])
    found = centres([0, 0], [(0.0, 10.0), (0.0, 10.5)])
    assert match_detections(true, found, np.array([0.5, 0.9]), 1.0).tolist() == [True, False]


def test_the_threshold_itself_is_too_far() -> None:
    true = centres([0], [(0.0, 10.0)])
    found = centres([0], [(0.0, 11.0)])
    assert not match_detections(true, found, np.ones(1), 1.0)[0]
    assert match_detections(true, found, np.ones(1), 1.001)[0]


def test_other_samples_do_not_match() -> None:
    assert not match_detections(centres([0], [(0, 10)]), centres([1], [(0, 10)]), np.ones(1), 4.0).any()


def test_precision_is_zero_beyond_the_recall_that_is_reached() -> None:
    precision = interpolate_precision(np.array([True]), 4)
    assert precision[:26].tolist() == [1.0] * 26
    assert not precision[26:].any()


def test_classes_without_truth_do_not_count_in_the_mean() -> None:
    car = ClassScores("car", 10, 8, {1.0: 0.2, 2.0: 0.4})
    person = ClassScores("pedestrian", 0, 3, {1.0: 0.0, 2.0: 0.0})
    scores = DetectionScores((car, person), 5)
    assert scores.mean_average_precision == pytest.approx(0.3)
    assert scores.at_threshold(2.0) == pytest.approx(0.4)
    assert math.isnan(DetectionScores((person,), 5).mean_average_precision)


def test_errors() -> None:
    good = centres([0], [(0.0, 10.0)])
    with pytest.raises(InputError, match="score is not finite"):
        match_detections(good, good, np.array([np.nan]), 1.0)
    with pytest.raises(InputError, match="detected centre is not finite"):
        match_detections(good, centres([0], [(np.inf, 1.0)]), np.ones(1), 1.0)
    with pytest.raises(InputError, match="nothing to average"):
        average_precision(np.ones(101), min_recall=1.0)
    with pytest.raises(InputError, match="no threshold of 3 m"):
        DetectionScores((ClassScores("car", 1, 1, {1.0: 1.0}),), 1).at_threshold(3.0)
