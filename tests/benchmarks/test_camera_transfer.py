"""Table 7 as claims: an overlap of found instances does not exist where a method finds nothing."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np
import pytest

from benchmarks.common.bench import Row
from benchmarks.common.claims import Claim
from benchmarks.perception.camera_transfer import RESAMPLES, _compare, camera_transfer_claims
from flows.perception.camera_transfer import DetectionPairs
from genre_tasks.detection.detections import Detections

CAR = 2


def find_cars(*boxes: tuple[float, float, float, float]) -> Detections:
    """One box a car."""
    count = len(boxes)
    return Detections(
        np.array(boxes, np.float32).reshape(-1, 4), np.ones(count, np.float32), np.full(count, CAR, np.int64)
    )


WHOLE = find_cars((0, 0, 10, 10))
NARROW = find_cars((0, 0, 8, 10))
NOTHING = find_cars()


def pair_with_recorded(rendered: Iterable[Detections]) -> DetectionPairs:
    found = tuple(rendered)
    return DetectionPairs((WHOLE,) * len(found), found, (CAR,))


OURS = pair_with_recorded([WHOLE] * 3)
BLIND = pair_with_recorded([NOTHING] * 3)


@pytest.mark.parametrize(("ours", "others"), [(OURS, BLIND), (BLIND, OURS), (BLIND, BLIND)])
def test_an_iou_of_found_instances_needs_finds_of_both(ours: DetectionPairs, others: DetectionPairs) -> None:
    row = _compare(ours, others, "box", "iou")
    assert row["mean"] is None
    assert row["interval"] == [None, None]
    assert row["undefined_resamples"] == RESAMPLES


def test_what_counts_missed_instances_is_compared_without_finds() -> None:
    for measure in ("ap", "recall", "iou_all"):
        row = _compare(OURS, BLIND, "box", measure)
        assert row["mean"] == pytest.approx(1.0)
        assert row["interval"] == pytest.approx([1.0, 1.0])
        assert row["undefined_resamples"] == 0


def test_resamples_without_a_find_of_the_rival_are_left_out() -> None:
    rival = pair_with_recorded([NARROW, NOTHING, NOTHING])
    row = _compare(OURS, rival, "box", "iou")
    assert row["mean"] == pytest.approx(0.2)
    # A resample of the two other images alone would have a difference of 1.
    assert row["interval"] == pytest.approx([0.2, 0.2])
    assert 0 < row["undefined_resamples"] < RESAMPLES / 2


def _claims_of(differences: Sequence[Row]) -> list[Claim]:
    named = [{"detector": f"detector_{k}", "other": "3dgs"} | d for k, d in enumerate(differences)]
    claims = camera_transfer_claims([{"log": "street", "differences": named}])
    return [claim for claim in claims if claim.id == "perception.transfer_3dgs_box_iou"]


def test_a_claim_says_in_how_many_cases_its_number_is_undefined() -> None:
    rival = pair_with_recorded([NARROW, NOTHING, NOTHING])
    undefined, known = _claims_of([_compare(OURS, others, "box", "iou") for others in (BLIND, rival)])
    assert undefined.measured is None and not undefined.holds
    assert known.measured == pytest.approx(0.2) and known.holds
    assert all("undefined in 1 of 2 cases" in claim.data for claim in (undefined, known))
    assert f"of {RESAMPLES} resamples" in known.data


def test_a_row_of_an_earlier_version_has_the_note_of_then() -> None:
    (claim,) = _claims_of([{"measure": "box/iou", "mean": 0.5, "interval": [0.4, 0.6]}])
    assert claim.data == "street, detector_0, GenRe+ less 3DGS; spread: 95 % over images"
