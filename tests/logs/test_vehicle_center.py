"""Readers whose vehicles have their origin at the rear axle say where the middle of the car is."""

from __future__ import annotations

from pathlib import Path

import pytest

from flows.training.subsampled_log import SubsampledLog
from genre_tasks.logs.registry import open_log
from genre_tasks.logs.vehicle_center import find_center_ahead
from tests.fakes import FakeLog
from tests.logs.argoverse2_folder import write_argoverse2
from tests.logs.kitti_folder import write_kitti
from tests.logs.nuscenes_folder import write_nuscenes
from tests.logs.waymo_folder import write_waymo

FAKE = FakeLog(frame_count=3, camera_names=("front",), lidar_azimuths=30, lidar_rings=4)


def test_datasets_with_the_origin_at_the_rear_axle_say_so(tmp_path: Path) -> None:
    nuscenes = open_log(f"nuscenes:{write_nuscenes(FAKE, tmp_path / 'nuscenes')}")
    assert find_center_ahead(nuscenes) == pytest.approx(1.3)
    assert find_center_ahead(open_log(f"waymo:{write_waymo(FAKE, tmp_path / 'waymo')}")) == pytest.approx(1.4)
    argoverse2 = open_log(f"argoverse2:{write_argoverse2(FAKE, tmp_path / 'argoverse2')}")
    assert find_center_ahead(argoverse2) == pytest.approx(1.4)
    assert find_center_ahead(SubsampledLog(argoverse2, 2)) == pytest.approx(1.4)


def test_other_logs_have_their_origin_in_the_middle(tmp_path: Path) -> None:
    assert find_center_ahead(open_log(f"kitti:{write_kitti(FAKE, tmp_path)}")) == 0.0
    assert find_center_ahead(open_log("synthetic:street?frames=4&cameras=1")) == 0.0
    # A log of another package keeps the protocol alone.
    assert find_center_ahead(FAKE) == 0.0
