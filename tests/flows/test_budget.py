"""A run within a given time: what is chosen, stepping down at borders, the clock, and the command."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from typer.testing import CliRunner

from flows.budget import budget as budgets
from flows.budget.chooser import STAGE_OVERHEAD_S, Chooser, count_images
from flows.budget.cost_table import CostPoint, CostTable, find_shipped_table, load_cost_table
from flows.budget.deadline import Deadline
from flows.cli.main import app
from flows.cli.parsing import parse_duration
from flows.comparison.run_comparison import compare_runs, open_side
from flows.configuration import apply_settings, load_configuration
from flows.cost_sweep.parquet import read_settings, write_settings
from flows.cost_sweep.summary import summarise_settings
from flows.pipeline.definition import stages_until
from flows.reconstruction import flow
from flows.reconstruction.chunk_configuration import read_chunk_config
from flows.reconstruction.run_records import list_runs
from flows.upkeep.what_if import find_recomputations
from genre_tasks.errors import ArtifactCorruptError, ConfigError
from storage.local import LocalStore
from tests.faults.small_run import LOG, SETTINGS

EARLY = {"ingest": 5.0, "effects": 1.0, "initial": 2.0}
LATE = {"novel_views": 2.0, "fnet": 10.0}
SMALL = load_configuration("small")


def point(name: str, gnet: int, enet: int, accuracy: float) -> CostPoint:
    """GNet takes a second an iteration, ENet two; 0 iterations of ENet: the scene is GNet's."""
    later = LATE | {"enet": 2.0 * enet} if enet else {}
    changes = (f"gnet.iterations={gnet}", *((f"enet.iterations={enet}",) if enet else ()))
    return CostPoint(name, changes, "enet" if enet else "gnet", accuracy, EARLY | {"gnet": float(gnet)} | later)


POINTS = (
    point("least", 2, 0, 20.0),
    point("alone", 10, 0, 24.0),
    point("worse", 20, 0, 23.0),
    point("short", 10, 2, 25.0),
    point("long", 10, 8, 26.0),
    point("most", 30, 8, 27.0),
)
TABLE = CostTable("small", "accuracy", POINTS, 120.0, 320 * 180, (), 0.1, {"ingest": 3.0}, "somewhere")


class Frozen(Deadline):
    """A clock that a test moves."""

    def __init__(self, budget_s: float) -> None:
        super().__init__(budget_s, 0.0)
        self.now = 0.0

    @property
    def used_s(self) -> float:
        return self.now


def chooser(clock: Deadline, speed: float = 1.0) -> Chooser:
    by = Chooser(TABLE, SMALL, clock, 1.0, lambda: speed)
    by.calibrate()
    return by


def simulated(
    budget_s: float, slower: Callable[[str], float], points: Sequence[CostPoint] = POINTS
) -> tuple[Frozen, str]:
    """A run whose stages take ``slower`` times what the table says: the clock at its end, and the last point."""
    clock = Frozen(budget_s)
    by = Chooser(replace(TABLE, points=tuple(points)), SMALL, clock, 1.0, lambda: 1.0)
    while (step := by.next_stage()) is not None:
        own = next(p for p in points if p.name == by.choices[-1].point)
        took = slower(step[0]) * (own.seconds[step[0]] + TABLE.first_call_s.get(step[0], 0.0) + STAGE_OVERHEAD_S)
        clock.now += took
        by.record_stage(step[0], took, cached=False)
    return clock, by.choices[-1].point


def test_the_most_accurate_that_fits_is_chosen_and_says_why() -> None:
    by = chooser(Frozen(45.0))
    step = by.next_stage()
    assert step is not None and step[0] == "ingest"
    assert step[1].gnet.iterations == 10 and step[1].enet.iterations == 2
    (choice,) = by.choices
    assert choice.point == "short" and choice.predicted_s == pytest.approx(1.06 * (34 + 3 + 7 * STAGE_OVERHEAD_S))
    assert "the best accuracy that fits; long would take" in str(choice)


def test_a_setting_that_was_chosen_is_kept_with_half_of_the_margin() -> None:
    clock = Frozen(45.0)
    by = chooser(clock)
    by.next_stage()
    without_margin_s = by.choices[0].predicted_s / 1.06
    clock.now = 45.0 - 1.04 * without_margin_s
    by.next_stage()
    assert [choice.point for choice in by.choices] == ["short"]
    clock.now = 45.0 - 1.02 * without_margin_s
    by.next_stage()
    assert [choice.point for choice in by.choices] == ["short", "alone"]


def test_a_slower_machine_gets_a_shorter_setting() -> None:
    fast, slow = chooser(Frozen(60.0), 1.0), chooser(Frozen(60.0), 1.8)
    assert [by.next_stage() and by.choices[0].point for by in (fast, slow)] == ["long", "alone"]


def test_more_than_all_takes_the_best_and_less_than_any_the_shortest() -> None:
    rich, poor = chooser(Frozen(1000.0)), chooser(Frozen(1.0))
    assert rich.next_stage() and poor.next_stage()
    assert rich.choices[0].point == "most" and "of all 6" in rich.choices[0].why
    assert poor.choices[0].point == "least" and "nothing fits" in poor.choices[0].why


def test_what_goes_slower_than_predicted_steps_down_to_what_is_reachable() -> None:
    clock, end = simulated(65.0, lambda stage: 2.5 if stage == "gnet" else 1.0)
    assert end == "alone"  # GNet had ten iterations when the time was gone: neither fewer nor fixing
    assert clock.now < 65.0


def test_what_goes_faster_steps_up() -> None:
    _, end = simulated(62.0, lambda _: 0.5)
    assert end == "most"


def test_a_fixer_that_overran_leaves_the_scene_that_is_there() -> None:
    clock, end = simulated(45.0, lambda stage: 3.0 if stage == "fnet" else 1.0)
    assert end == "alone" and clock.now < 65.0


def test_a_chunks_share_is_of_what_was_left_when_it_began() -> None:
    clock = Frozen(90.0)
    by = Chooser(TABLE, SMALL, clock, 1.0, lambda: 1.0)
    while (step := by.next_stage(0.5)) is not None:  # the first of two chunks
        own = next(p for p in POINTS if p.name == by.choices[-1].point)
        took = own.seconds[step[0]] + TABLE.first_call_s.get(step[0], 0.0) + STAGE_OVERHEAD_S
        clock.now += took
        by.record_stage(step[0], took, cached=False)
    assert by.choices[0].left_s == 45.0 and {c.point for c in by.choices} == {"short"}
    assert clock.now < 45.0 and by._until_s == 45.0


@settings(deadline=None)
@given(st.floats(5.0, 120.0), st.floats(0.3, 3.0))
def test_accuracy_does_not_fall_as_the_budget_grows(budget_s: float, pace: float) -> None:
    accuracy = {p.name: p.accuracy for p in POINTS}
    ends = [simulated(b, lambda _: pace)[1] for b in (budget_s, 1.2 * budget_s, 2 * budget_s)]
    assert sorted(ends, key=accuracy.__getitem__) == ends


def test_stages_from_the_store_tell_nothing_of_the_pace() -> None:
    by = chooser(Frozen(60.0))
    while (step := by.next_stage()) is not None:
        by.record_stage(step[0], 0.01, cached=True)
    assert by.predict_s(POINTS[-1]) == 0
    fresh = chooser(Frozen(60.0))
    assert fresh.next_stage()
    assert fresh.predict_s(POINTS[0]) == pytest.approx(1.06 * (8 + 3 + 2 + 4 * STAGE_OVERHEAD_S))


def test_speed_is_asked_for_once_and_only_when_something_was_computed() -> None:
    asked: list[float] = []

    def speed() -> float:
        asked.append(1.5)
        return 1.5

    by = Chooser(TABLE, SMALL, Frozen(80.0), 1.0, speed)
    assert by.next_stage() and by.choices[0].pace == 1.0
    by.record_stage("ingest", 0.01, cached=True)
    assert by.next_stage() and not asked
    by.record_stage("effects", 1.5 * (1.0 + STAGE_OVERHEAD_S), cached=False)
    assert by.next_stage() and asked == [1.5]
    by.record_stage("initial", 1.5 * (2.0 + STAGE_OVERHEAD_S), cached=False)
    assert by.next_stage() and asked == [1.5] and by.choices[-1].pace == pytest.approx(1.5)


def test_what_the_user_has_set_is_not_turned(tmp_path: Path) -> None:
    table = written(tmp_path / "cost.parquet")
    with pytest.raises(ConfigError, match=r"gnet.iterations is what a budget decides.*Leave out"):
        load_cost_table(table, "demo", user_keys=("gnet.iterations", "ingest.strict"))
    assert load_cost_table(table, "demo", user_keys=("ingest.strict",))


def test_the_command_says_what_does_not_fit_before_a_server_is_started(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(flow, "reconstruct_log", None)  # would end in a TypeError
    table = str(written(tmp_path / "cost.parquet"))
    told = ["run", LOG, "--preset", "demo", "--budget", "1h", "--table", table, "--set", "gnet.iterations=3"]
    with pytest.raises(ConfigError, match=r"gnet\.iterations is what a budget decides"):
        CliRunner().invoke(app, told, catch_exceptions=False)


def test_images_of_a_chunk_are_frames_times_cameras() -> None:
    assert count_images("synthetic:street?seed=900&frames=25&cameras=2", 1, SMALL) == 10
    one = load_configuration("small", settings=["ingest.cameras=[front_camera]"])
    assert count_images("synthetic:street?seed=900&frames=25&cameras=2", 0, one) == 20


class FakeTime:
    """The two clocks of a machine, moved by a test."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.wall_s = 1e9
        self.monotonic_s = 50.0
        clocks = SimpleNamespace(time=lambda: self.wall_s, monotonic=lambda: self.monotonic_s)
        monkeypatch.setattr("flows.budget.deadline.time", clocks)

    def go_on(self, seconds: float) -> None:
        self.wall_s += seconds
        self.monotonic_s += seconds


def test_the_clock_stands_still_while_it_is_paused(monkeypatch: pytest.MonkeyPatch) -> None:
    now = FakeTime(monkeypatch)
    clock = Deadline(10.0, now.wall_s - 4.0)
    with clock.paused():
        now.go_on(0.25)
    assert clock.used_s == pytest.approx(4.0) and clock.left_s == pytest.approx(6.0)
    now.go_on(1.0)
    assert clock.used_s == pytest.approx(5.0) and clock.left_s == pytest.approx(5.0)


def test_a_corrected_wall_clock_does_not_change_what_is_left(monkeypatch: pytest.MonkeyPatch) -> None:
    now = FakeTime(monkeypatch)
    clock = Deadline(300.0, now.wall_s - 20.0)
    for jump_s in (3600.0, -7200.0):
        now.wall_s += jump_s
        assert clock.left_s == pytest.approx(280.0)


@pytest.mark.parametrize(("text", "value"), [("90", 90), ("90s", 90), ("1.5m", 90), ("2min", 120), ("1h", 3600)])
def test_times_are_read(text: str, value: float) -> None:
    assert parse_duration(text, "--budget") == value and parse_duration(None, "--budget") is None


@pytest.mark.parametrize("text", ["soon", "0", "-3s", "3d", ""])
def test_other_times_are_refused(text: str) -> None:
    with pytest.raises(ConfigError, match="--budget"):
        parse_duration(text, "--budget")


def written(path: Path, preset: str = "demo", **facts: str) -> Path:
    """A table of two settings that take no time to speak of, and one that takes a minute."""
    said = {"base": preset, "judged": "psnr", "calibration_s": "0.1", "cold_seconds": "{}", "machine": "somewhere"}
    rows = [
        table_row("", (), "enet", 60.0, 27.0),
        table_row("short", ("gnet.iterations=1", "enet.iterations=1"), "enet", 0.01, 25.0),
        table_row("alone", ("gnet.iterations=1",), "gnet", 0.005, 24.0),
        table_row("coarse", ("ingest.width_px=32", "ingest.height_px=18"), "gnet", 0.001, 31.0),
        table_row("rigid_actors off", ("effects.rigid_actors=off",), "enet", 0.001, 30.0, "effects"),
    ]
    write_settings(path, summarise_settings(rows), said | facts)
    return path


def table_row(
    value: str, changes: tuple[str, ...], end: str, stage_s: float, psnr: float, knob: str = "together"
) -> dict[str, Any]:
    stages = [*EARLY, "gnet", *([*LATE, "enet"] if end == "enet" else [])]
    return {
        "knob": knob if value else "preset",
        "value": value,
        "setting": f"{knob}={value}" if value else "preset",
        "changes": changes,
        "end": end,
        "threads": 0,
        "log": "a",
        "chunk": 0,
        "seed": 0,
        "images": 8,
        "peak_mib": 1.0,
        "seconds": dict.fromkeys(stages, stage_s),
        "cpu_seconds": dict.fromkeys(stages, stage_s),
        "gaussians": 10,
        "metrics": {"interpolation/psnr": psnr},
    }


def test_a_table_comes_back_as_written_and_effects_and_sizes_are_no_choice(tmp_path: Path) -> None:
    path = written(tmp_path / "cost.parquet")
    lines, facts = read_settings(path)
    settings = ["preset", "together=short", "together=alone", "together=coarse", "effects=rigid_actors off"]
    assert [x.setting for x in lines] == settings
    assert lines[1].changes == ("gnet.iterations=1", "enet.iterations=1") and facts["machine"] == "somewhere"
    table = load_cost_table(path, "demo")
    assert [p.name for p in table.points] == ["preset", "together=short", "together=alone"]
    part = tmp_path / "part.parquet"  # with a setting that was not measured wherever the preset was
    write_settings(part, [lines[0], replace(lines[1], n=2), *lines[2:]], facts)
    assert [p.name for p in load_cost_table(part, "demo").points] == ["preset", "together=alone"]
    assert table.points[2].accuracy == 24.0 and set(table.points[2].seconds) == {*EARLY, "gnet"}


def test_tables_that_do_not_fit_are_refused(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"of the preset demo.*genre cost LOG --preset small"):
        load_cost_table(written(tmp_path / "cost.parquet"), "small")
    with pytest.raises(ConfigError, match="no times were measured for the preset paper"):
        find_shipped_table("paper")
    (tmp_path / "other.parquet").write_bytes(b"no table")
    with pytest.raises(ArtifactCorruptError, match=r"other\.parquet"):
        load_cost_table(tmp_path / "other.parquet", "demo")


@pytest.fixture(scope="module")
def prefect() -> Iterator[None]:
    from prefect.testing.utilities import prefect_test_harness

    with prefect_test_harness(server_startup_timeout=120):
        yield


@pytest.mark.usefixtures("prefect")
def test_a_run_ends_where_its_budget_says(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    own = [s for s in SETTINGS if not s.startswith(("gnet.iterations", "enet.iterations"))]
    table = str(written(tmp_path / "cost.parquet"))
    monkeypatch.setattr(budgets, "measure_calibration_s", lambda: 0.1)

    def run(budget_s: float) -> tuple[list[str], dict[str, Any]]:
        """The stages that were made, and the record; the report says, too, what the scene was made with."""
        done = flow.reconstruct_log(
            LOG, preset="demo", store=str(tmp_path / "store"), settings=own, budget_s=budget_s, table=table
        )
        assert done["chunks"][0]["warnings"][0].startswith("within a budget: gnet.iterations=1")
        assert "within a budget: gnet.iterations=1" in Path(done["report"]).read_text()
        return [s["stage"] for s in done["chunks"][0]["stages"]], done["budget"]

    stages, record = run(100.0)
    assert {"enet", "evaluate/enet"} <= set(stages)
    assert record["chunks"][0]["choices"][0]["point"] == "together=short" and 0 < record["used_s"] < 100
    assert record["chunks"][0]["settings"] == ["gnet.iterations=1", "enet.iterations=1"]
    stages, record = run(0.01)
    assert stages == ["ingest", "effects", "initial", "gnet", "evaluate/initial", "evaluate/gnet"]
    assert record["chunks"][0]["choices"][0]["point"] == "together=alone"
    assert "nothing fits" in record["chunks"][0]["choices"][0]["why"]
    _check_later_readers(LocalStore(tmp_path / "store"))


def _check_later_readers(store: LocalStore) -> None:
    """What reads a run's record later takes the settings that were chosen, and not those that were asked for."""
    long, short = list_runs(store.uri)
    assert long["config"]["gnet"]["iterations"] != 1 and read_chunk_config(short, 0).gnet.iterations == 1
    assert find_recomputations(short, "gnet.iterations=1") == []
    assert find_recomputations(short, f"gnet.iterations={short['config']['gnet']['iterations']}")
    compared = compare_runs(open_side(store, long), open_side(store, short))
    (rows,) = (table.rows for table in compared.tables if table.name == "chunk 0 settings within a budget")
    assert [row["setting"] for row in rows] == ["enet.iterations"]
    before = {artifact.address: artifact.manifest.payload_digest for artifact in store.artifacts()}
    (gnet,) = store.artifacts(stage="gnet")
    scene = next(gnet.path.glob("*.parquet"))
    scene.write_bytes(scene.read_bytes()[:-1])
    done = CliRunner().invoke(app, ["verify", "--repair", "--store", store.uri], catch_exceptions=False)
    assert done.exit_code == 0 and "repaired: " in done.output, done.output
    # Neither another run nor a stage beyond the chunk's last one.
    assert {artifact.address: artifact.manifest.payload_digest for artifact in store.artifacts()} == before
    assert [run["run"] for run in list_runs(store.uri)] == [long["run"], short["run"]]


def test_the_command_says_what_it_would_choose(tmp_path: Path) -> None:
    own = [part for s in SETTINGS if "iterations" not in s for part in ("--set", s)]
    told = ["run", LOG, "--preset", "demo", *own, "--store", str(tmp_path), "--dry-run"]
    table = str(written(tmp_path / "cost.parquet"))
    done = CliRunner().invoke(app, [*told, "--budget", "1h", "--table", table])
    assert done.exit_code == 0, done.output
    assert "budget 3600 s" in done.output and "preset:" in done.output and "evaluate/enet" in done.output
    done = CliRunner().invoke(app, [*told, "--budget", "0.01s", "--table", table, "--json"])
    plan = json.loads(done.stdout.splitlines()[-1])
    made = ["ingest", "effects", "initial", "gnet", "evaluate/initial", "evaluate/gnet"]
    assert "together=alone" in done.output and [row["stage"] for row in plan["stages"]] == made
    with pytest.raises(ConfigError, match="--budget"):
        CliRunner().invoke(app, [*told, "--table", table], catch_exceptions=False)
    with pytest.raises(ConfigError, match=r"gnet\.iterations is what a budget decides"):
        CliRunner().invoke(
            app, [*told, "--budget", "1h", "--table", table, "--set", "gnet.iterations=3"], catch_exceptions=False
        )


@pytest.mark.parametrize(("preset", "least_points", "seeds"), [("small", 20, 3), ("fine", 20, 1), ("hd", 15, 1)])
def test_the_shipped_table_is_of_today_s_settings(preset: str, least_points: int, seeds: int) -> None:
    table = load_cost_table(find_shipped_table(preset), preset)
    lines, facts = read_settings(find_shipped_table(preset))
    assert len(table.points) >= least_points and min(x.n for x in lines) >= seeds
    assert facts["machine"] == table.machine
    base = load_configuration(preset)
    for p in table.points:
        config = apply_settings(base, p.changes)
        assert p.name == "preset" or p.end == "gnet" or config != base, p.name
        assert set(p.seconds) == set(stages_until(p.end)) and all(s >= 0 for s in p.seconds.values())
    assert set(table.first_call_s) == set(stages_until("enet")) and table.calibration_s > 0 and table.images > 1
