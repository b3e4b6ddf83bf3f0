"""Table 6: rollouts that a log has room for, their scores, paired differences, cells of all chunks, and its figures."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from flows.experiments.log_chunks import LogChunk
from flows.paper_tables.builtin_methods import BUILT_IN
from flows.paper_tables.columns import MeasuredCell
from flows.paper_tables.flow import write_results
from flows.paper_tables.layouts import LAYOUTS, PROTOCOL
from flows.paper_tables.measure import Basis
from flows.paper_tables.method_differences import average_by_behaviour, compare_methods
from flows.paper_tables.request import TableRequest, find_unstored_methods, predict_table
from flows.paper_tables.rollout_cells import describe_rollouts, measure_rollout_cell
from flows.paper_tables.rollouts import TABLE_ROLLOUTS, TableRollout, plan_rollout, take_every
from flows.paper_tables.simulation_scores import RolloutRow
from flows.pipeline.stage_runner import run_stage
from genre_tasks.config import SimulateConfig
from genre_tasks.ego_paths.ego_path import EgoPath
from genre_tasks.ego_paths.world_actors import WorldActor
from genre_tasks.errors import ConfigError, InputError
from genre_tasks.logs.synthetic import SyntheticStreet
from tests.faults.small_run import SETTINGS

LOG = "synthetic:street?seed=900&frames=8&cameras=1&width=64&height=36&lidar_beams=32&lidar_azimuths=300"
CHUNKED = (*(s for s in SETTINGS if "snapshots" not in s), "ingest.chunk_frames=4", "ingest.source_every=2")


def straight_path(speed_m_s: float, frames: int) -> EgoPath:
    poses = np.tile(np.eye(4), (frames, 1, 1))
    poses[:, 0, 3] = 0.1 * speed_m_s * np.arange(frames)
    return EgoPath(0.1 * np.arange(frames), np.arange(frames, dtype=np.float64), poses)


def standing_car(x_m: float, y_m: float, frames: int) -> WorldActor:
    poses = np.tile(np.eye(4), (frames, 1, 1))
    poses[:, :2, 3] = (x_m, y_m)
    return WorldActor("parked", "Car", (4.0, 1.8, 1.5), np.arange(frames), poses)


def test_a_behaviour_is_weaker_where_the_log_is_short_or_a_road_user_is_in_the_way() -> None:
    config = SimulateConfig()
    long = straight_path(10.0, 60)
    free = plan_rollout(TableRollout("accelerate", 3.0), long, config)
    assert free.strength == 1.0 and free.collisions == ()
    assert free.path.world_SE3_ego[0, 1, 3] == pytest.approx(3.0, abs=1e-6)
    # Between where the strongest and the weakest acceleration end.
    reach_m = free.path.world_SE3_ego[-1, 0, 3]
    behind = plan_rollout(TableRollout("accelerate", 3.0), long, config, [standing_car(reach_m, 3.0, 60)])
    assert behind.strength < 1 and behind.collisions == ()
    assert behind.path.world_SE3_ego[-1, 0, 3] < reach_m - 4
    assert (free.start_offset_m, behind.start_offset_m) == (3.0, 3.0)
    # Where poses are at the rear axle, the bonnet is nearer to who stands ahead.
    near = [standing_car(reach_m + 4.5, 3.0, 60)]
    assert plan_rollout(TableRollout("accelerate", 3.0), long, config, near).strength == 1.0
    assert plan_rollout(TableRollout("accelerate", 3.0), long, config, near, center_ahead_m=1.4).strength < 1
    assert plan_rollout(TableRollout("swerve", 3.0), straight_path(10.0, 30), config).strength < 1
    with pytest.raises(ConfigError):
        plan_rollout(TableRollout("swerve", 3.0), straight_path(10.0, 8), config)


def test_a_rollout_starts_nearer_to_the_recorded_path_where_road_users_are_in_the_way_of_every_strength() -> None:
    config = SimulateConfig()
    long = straight_path(10.0, 60)
    parked = plan_rollout(TableRollout("accelerate", -3.0), long, config, [standing_car(20.0, -3.5, 60)])
    assert parked.start_offset_m == -1.5 and parked.strength == 1.0 and parked.collisions == ()
    assert parked.path.world_SE3_ego[0, 1, 3] == pytest.approx(-1.5, abs=1e-6)
    # Half a metre farther out it would meet the car: nothing nearer was taken than what it takes.
    row_of_cars = [standing_car(20.0, y, 60) for y in (3.5, 1.0)]
    blocked = plan_rollout(TableRollout("accelerate", 3.0), long, config, row_of_cars)
    assert blocked.start_offset_m == 3.0 and blocked.strength == 1.0 and "Car parked at" in blocked.collisions[0]
    remarks = describe_rollouts([replace(row("A", "log", parked.rollout), start_offset_m=parked.start_offset_m)])
    assert remarks == ("accelerate from -3 m on log starts at -1.5 m, as road users are farther out",)


def test_every_second_pose_of_a_path() -> None:
    path = take_every(straight_path(10.0, 7), 2)
    assert path.frames.tolist() == [0, 2, 4, 6] and len(path) == 4
    assert path.world_SE3_ego[:, 0, 3].tolist() == [0, 2, 4, 6]


def row(method: str, log: str, rollout: TableRollout, **metrics: float) -> RolloutRow:
    return RolloutRow(method, log, (0, 1), rollout, rollout.start_offset_m, 1.0, 20, metrics)


def test_differences_are_paired_by_log_and_their_interval_is_students() -> None:
    left, right = TableRollout("brake", 3.0), TableRollout("brake", -3.0)
    rows = []
    for k, gain in enumerate((1.0, 2.0, 3.0)):
        for rollout, offset in ((left, 0.5), (right, -0.5)):
            # Logs differ by far more than methods: only pairing can find the gain.
            rows.append(row("A", f"log{k}", rollout, psnr=20 * k + gain + offset, kernel=0.1))
            rows.append(row("B", f"log{k}", rollout, psnr=20.0 * k, kernel=0.3 + 0.1 * k))
    rows.append(row("A", "only A", left, psnr=99.0))
    psnr, kernel = compare_methods(rows, "A", "B")
    assert (psnr.behaviour, psnr.metric, psnr.n) == ("brake", "psnr", 3)
    assert psnr.mean == pytest.approx(2.0)
    assert (psnr.low, psnr.high) == pytest.approx((2 - 4.302653 / math.sqrt(3), 2 + 4.302653 / math.sqrt(3)), abs=1e-5)
    assert not psnr.is_better
    assert kernel.mean == pytest.approx(-0.3) and kernel.high < 0 and kernel.is_better
    single = compare_methods([r for r in rows if r.log == "log1"], "A", "B")[0]
    assert single.mean == pytest.approx(2.0) and math.isnan(single.low) and not single.is_better


def test_a_behaviours_number_is_the_mean_of_both_sides() -> None:
    rows = [
        row(
            "A", "log", TableRollout("swerve", 3.0), **{"psnr": 20.0, "psnr/n": 12.0, "kernel": 0.2, "kernel/low": 0.1}
        ),
        row("A", "log", TableRollout("swerve", -3.0), **{"psnr": 24.0, "psnr/n": 12.0}),
    ]
    values = average_by_behaviour(rows)
    assert values["swerve/psnr"] == 22.0 and values["swerve/psnr/n"] == 24.0
    assert values["swerve_left/kernel/low"] == 0.1
    # A mean over one side alone would not compare with one over both.
    assert "swerve/kernel" not in values and "brake/psnr" not in values


def refuse_boxes(log: object) -> tuple[object, ...]:
    raise InputError("row 0 is of frame 999", remedy="Correct the boxes.")


def test_table_6_has_a_cell_for_all_chunks_of_a_log_and_goes_on_where_it_was(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    # Half a second has no room for a lane change.
    rollouts = tuple(r for r in TABLE_ROLLOUTS if r.behaviour == "brake")
    layout = replace(LAYOUTS[6], rollouts=rollouts)
    basis = Basis("demo", (*CHUNKED, "gnet.per_scene.iterations=12"), str(tmp_path))
    places = [LogChunk(LOG, 0), LogChunk(LOG, 1)]
    method = replace(BUILT_IN["gnet"], name="GNet")
    cell = measure_rollout_cell(basis, layout, method, places, run_stage)
    assert cell.chunk is None and cell.seconds["gnet"] > 0
    left, right = cell.metrics["brake_left/psnr"], cell.metrics["brake_right/psnr"]
    assert left != right and cell.metrics["brake/psnr"] == pytest.approx((left + right) / 2)
    # A log whose boxes cannot be read has scenes, and so a cell that says what it lacks.
    with monkeypatch.context() as patched:
        patched.setattr(SyntheticStreet, "tracks", refuse_boxes)
        unchecked = measure_rollout_cell(basis, layout, method, places, run_stage)
    assert math.isfinite(unchecked.metrics["brake/psnr"])
    lacks = f"the boxes of {LOG} cannot be read: no path was checked against parked vehicles"
    assert unchecked.remarks.count(lacks) == 1 and lacks not in cell.remarks
    # Every second of eight poses, one camera.
    assert cell.metrics["brake_left/psnr/n"] == 4 and cell.metrics["brake_left/kernel/n"] == 4
    assert math.isfinite(cell.metrics["brake/kernel"]) and 5 < left < 60

    def refuse(*_: object, **__: object) -> None:
        raise AssertionError("rendered again")

    monkeypatch.setattr("flows.paper_tables.simulation_scores.render_rollout", refuse)
    assert measure_rollout_cell(basis, layout, method, places, run_stage) == cell
    request = TableRequest(6, (LOG,), "demo", str(tmp_path), settings=basis.settings).check()
    checked = replace(request, layout=replace(layout, rows=(replace(layout.rows[0], label="GNet", method=method),)))
    assert checked.group_places() == [tuple(places)]
    assert predict_table(checked)[-1]["cached"] == "2 of 2 rollouts" and find_unstored_methods(checked) == {}
    more = replace(checked, layout=replace(checked.layout, rollouts=(*rollouts, TableRollout("brake", 1.0))))
    assert find_unstored_methods(more) == {"GNet": f"the store has not 1 of the rollouts of {LOG} yet."}


def test_the_page_of_table_6_has_the_papers_numbers_and_what_was_driven(tmp_path: Path) -> None:
    request = TableRequest(6, ("synthetic:street?seed=950&frames=40",), out=str(tmp_path))
    checked = request.check()
    assert [len(places) for places in checked.group_places()] == [2]
    # A recorded path goes through the chunks in the order of the log.
    turned = replace(request, chunks=(1, 0)).check().group_places()
    assert [[where.chunk for where in places] for places in turned] == [[0, 1]]
    assert checked.config.evaluate.every == 2

    def cell(method: str, kernel: float) -> MeasuredCell:
        metrics = {f"{name}/kernel": kernel for name in ("brake", "accelerate", "lane-change", "swerve")}
        remarks = ("accelerate from +3 m at strength 0.5, as there is no room for more",)
        return MeasuredCell(method, request.logs[0], None, {}, {}, metrics | {"swerve/psnr": 26.0}, 9, 0, remarks)

    files = write_results(request, checked, [cell("3DGS", 0.4), cell("GenRe+", 0.2)], {"Difix3D-style": "no time."})
    page = Path(files[1]).read_text()
    assert "| method | kernel brake / FID brake | kernel accelerate / FID accelerate |" in page
    assert "| GenRe+ | **0.200** / 152.38 | **0.200** / 143.03 | **0.200** / 77.69 | **0.200** / 78.49 |" in page
    assert "| Difix3D-style | not measured / 182.40 |" in page
    assert page.count("at strength 0.5") == 1 and "PSNR swerve" in page


def test_rollouts_use_the_protocol_of_the_other_tables() -> None:
    scenes = ("ingest", "initial", "gnet", "novel_views", "fnet", "enet")
    for key in ("3dgs", "difix", "genre+"):
        ours = BUILT_IN[key].configuration("small", LAYOUTS[6].protocol)
        theirs = BUILT_IN[key].configuration("small", PROTOCOL)
        # Equal sections give equal keys, so that tables share the scenes.
        assert all(getattr(ours, name) == getattr(theirs, name) for name in scenes)
