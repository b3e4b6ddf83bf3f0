"""Datasets whose vehicles have their origin at the rear axle, and where the middle of their cars is."""

from __future__ import annotations

import pytest

from genre_tasks.logs.nuscenes.reader import CAR_HIGH_M, CAR_LOW_M
from genre_tasks.logs.registry import known_readers
from genre_tasks.logs.vehicle_center import _CENTER_AHEAD_M, find_center_ahead


def test_the_middle_of_the_car_of_nuscenes_is_that_of_its_corners() -> None:
    assert find_center_ahead("nuscenes:data/scene-0103?rate=10") == pytest.approx((CAR_LOW_M[0] + CAR_HIGH_M[0]) / 2)


def test_every_dataset_that_is_named_has_a_reader() -> None:
    assert _CENTER_AHEAD_M.keys() <= set(known_readers())


def test_a_setting_says_it_for_logs_of_ones_own() -> None:
    assert find_center_ahead("genre:log", 1.4) == 1.4
    # Also that it is at the origin, where a dataset was converted by hand.
    assert find_center_ahead("nuscenes:data/scene-0103", 0.0) == 0.0


@pytest.mark.parametrize("uri", ["pandaset:data/002", "kitti:data/drive", "synthetic:street?seed=1", "genre:log"])
def test_other_logs_have_their_origin_in_the_middle(uri: str) -> None:
    assert find_center_ahead(uri) == 0.0
