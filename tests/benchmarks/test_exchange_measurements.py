"""What is measured of formats: round trips of a small scene, and the import of a small file."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from benchmarks.common.bench import NotMeasuredError, Row
from benchmarks.exchange import round_trips
from benchmarks.exchange.import_speed import import_speed_claims, import_speed_table, measure_import_speed
from benchmarks.exchange.interop import interop_claims
from benchmarks.exchange.round_trips import RoundTripCase, measure_round_trip, round_trip_claims, round_trip_table
from genre_tasks.exchange.conversion import to_scene_graph
from genre_tasks.logs.types import Lens
from genre_tasks.scene.chunk import View
from tests.exchange.splat_clouds import make_driving_scene
from tests.storage import artifact_values

CASE = RoundTripCase("store", "run")


@pytest.fixture
def rows(monkeypatch: pytest.MonkeyPatch) -> list[Row]:
    """Of a small scene in place of a run's."""
    drawn = make_driving_scene()
    lens = Lens(fx_px=30.0, fy_px=30.0, cx_px=24.0, cy_px=16.0, width_px=48, height_px=32)
    views = tuple(View("front", frame, "source", 0.1 * frame, np.eye(4), lens, b"") for frame in drawn.frames)
    chunk = replace(artifact_values.make("chunk"), frames=drawn.frames, views=views)
    scene = to_scene_graph(drawn)
    monkeypatch.setattr(round_trips, "read_stage_value", lambda *_: (0, chunk))
    monkeypatch.setattr(round_trips, "read_stage_scene", lambda *_: scene)
    monkeypatch.setattr(round_trips, "find_last_stage", lambda *_: "initial")
    return [measure_round_trip(name, CASE, degree) for name, degree in (("ply", 0), ("ply", 3), ("splat", 0))]


def test_round_trips(rows: list[Row]) -> None:
    ply, harmonics, splat = rows
    for row in (ply, harmonics):
        assert set(row["errors"].values()) == {0.0}
        assert (row["psnr_db"], row["difference"], row["psnr_as_read_db"]) == (100.0, 0.0, 100.0)
    assert harmonics["bytes_per_gaussian"] - ply["bytes_per_gaussian"] == pytest.approx(180, abs=25)
    assert splat["bytes_per_gaussian"] == 32
    assert 0 < splat["errors"]["angles_rad"] < 0.018
    assert splat["psnr_db"] < 100


def test_claims_of_round_trips(rows: list[Row]) -> None:
    claims = {claim.id: claim for claim in round_trip_claims(rows)}
    assert claims["exchange.ply_error"].holds and claims["exchange.ply_error"].n == 2
    assert claims["exchange.splat_difference"].measured == rows[2]["difference"]
    # What was not measured does not hold.
    for name in ("spz_bytes", "glb_error", "usdz_error"):
        assert claims[f"exchange.{name}"].measured is None and not claims[f"exchange.{name}"].holds
    worse = [rows[0] | {"errors": rows[0]["errors"] | {"colors": 1e-9}}, *rows[1:]]
    assert not {claim.id: claim for claim in round_trip_claims(worse)}["exchange.ply_error"].holds
    assert len(list(round_trip_table(rows))) == 2 + len(rows)


def test_what_is_read_only_is_not_measured() -> None:
    with pytest.raises(NotMeasuredError, match="read only"):
        measure_round_trip("compressed.ply", CASE)


def test_a_tool_that_loses_gaussians_misses_its_claims() -> None:
    sound = {"missing": 0, "matched": 1.0, "means_m": 1e-4}
    shared: Row = {"validator": {"errors": 0}, "three_place": 0.0}
    for ways, missing, farthest_m in (
        ({"spz, ply": sound, "ply, spz": sound}, 0, 1e-4),
        ({"spz, ply": {"missing": 3}, "ply, spz": sound}, 3, None),
        ({"spz, ply": sound, "ply, spz": {"missing": -2}}, 2, 1e-4),
    ):
        claims = {claim.id.rpartition("_")[2]: claim for claim in interop_claims([shared | {"ways": ways}])}
        assert (claims["missing"].measured, claims["spz"].measured) == (missing, farthest_m)
        assert claims["missing"].holds == (missing == 0) and claims["spz"].holds == (farthest_m is not None)
    assert not any(claim.holds for claim in interop_claims([]))


def test_import_speed() -> None:
    row = measure_import_speed(rounds=1, gaussians=20_000)
    assert row["bytes"] == pytest.approx(20_000 * 236, rel=0.01)
    assert row["seconds"]["median"] > 0 and row["memory"] > 0.5
    assert [claim.id for claim in import_speed_claims([row])] == ["exchange.import_s", "exchange.import_memory"]
    assert not any(claim.holds for claim in import_speed_claims([]))
    assert len(list(import_speed_table([row]))) == 3
