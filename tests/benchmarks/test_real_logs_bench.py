"""The benchmark of real logs: what its rows depend on, and logs that are not there."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest

from benchmarks.common.bench import NotMeasuredError, Row
from benchmarks.common.task import has_log_folder, require_log_folder
from benchmarks.real_logs import BENCH
from benchmarks.real_logs.measures import LogOfBench, measure_chain, measure_effects
from benchmarks.real_logs.optimiser_race import measure_race


def _measure_race(log: LogOfBench) -> Row:
    return measure_race(log, 0, "tuned_adam")


@pytest.mark.parametrize("measure", [measure_chain, measure_effects, _measure_race])
@pytest.mark.parametrize("uri", ["kitti:nowhere/drive?labels=x.txt", "pandaset:nowhere/002"])
def test_a_log_that_is_not_there_is_not_measured(measure: Callable[[LogOfBench], Row], uri: str) -> None:
    with pytest.raises(NotMeasuredError, match=r"there is no folder nowhere/\w+;"):
        measure(LogOfBench(uri, 0, "small", (), "store"))


def test_logs_are_looked_for_where_their_readers_do(tmp_path: Path) -> None:
    (tmp_path / "a b").mkdir()
    (tmp_path / "transforms.json").touch()
    for log in ("pandaset:a b", "kitti:a%20b?labels=none.txt", "posed_images:transforms.json", "nuscenes:a b/scene-1"):
        reader, _, path = log.partition(":")
        assert has_log_folder(f"{reader}:{tmp_path}/{path}"), log
        with pytest.raises(NotMeasuredError):
            require_log_folder(f"{reader}:{tmp_path}/nowhere/{path}")
    assert has_log_folder("synthetic:street?seed=1")


def test_rows_depend_on_settings_weights_and_variants() -> None:
    cells = {cell.name: cell.parameters for cell in BENCH.cells(dict(BENCH.options), False)}
    for parameters in cells.values():
        assert set(parameters["weights"]) == {"gnet", "fnet", "enet"}
        assert parameters["configuration"]["gnet"]["iterations"] > 0
    races = [parameters for name, parameters in cells.items() if name.startswith("race")]
    assert races and all(race["variants"] for race in races)


def test_claims_fail_where_nothing_was_measured_and_name_what_was() -> None:
    claims = {claim.id: claim for claim in BENCH.claims({})}
    assert all(claim.measured is None for claim in claims.values())
    assert "real_logs.effects_gain" in claims
    scores = {"psnr": 22.0, "kernel_3m": 0.1}
    chain = {"kind": "chain", "log": "kitti drive chunk 0", "gnet": scores, "enet": scores}
    for row, text in (
        (chain, "kitti drive chunk 0"),
        (chain | {"cameras": 3, "size_px": [64, 36]}, "kitti drive chunk 0, 3 cameras at 64 x 36"),
    ):
        found = {claim.id: claim.data for claim in BENCH.claims({"chain kitti": row})}
        assert found["real_logs.kitti_enet_heldout"] == text
