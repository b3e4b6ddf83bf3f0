"""What a budget predicts seconds from: the machine's speed, stages that have run before, sizes of images, the table."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from flows.budget import budget as budgets
from flows.budget.budget import Budget, resolve_table
from flows.budget.chooser import STAGE_OVERHEAD_S, Chooser
from flows.budget.cost_table import load_cost_table
from flows.configuration import load_configuration
from flows.cost_sweep import plot
from flows.cost_sweep.parquet import write_settings
from flows.cost_sweep.plot import draw_sweep
from flows.cost_sweep.summary import PSNR, summarise_settings
from genre_tasks.errors import ConfigError
from tests.flows.test_budget import POINTS, SMALL, TABLE, Frozen, table_row, written

LOG = "synthetic:street?seed=900&frames=16&cameras=2"


def test_the_speed_is_known_before_gnet_is_chosen_where_stages_come_from_the_store() -> None:
    by = Chooser(TABLE, SMALL, Frozen(60.0), 1.0, lambda: 1.8)
    assert by.next_stage() and by.choices[0].point == "long"
    by.record_stage("ingest", 0.01, cached=True)
    by.record_stage("effects", 0.01, cached=True)
    # At the table's speed "long" would fit; at this machine's it does not.
    assert by.next_stage() and by.choices[-1].point != "long" and by.choices[-1].pace == 1.8
    assert by.computed_stages == set()


def budget_of(tmp_path: Path, **cold: float) -> Budget:
    table = written(tmp_path / "cost.parquet", cold_seconds=json.dumps(cold))
    return Budget(100.0, None, str(table), "demo", load_configuration("demo", settings=["ingest.chunk_frames=8"]))


def test_a_later_chunk_knows_the_speed_and_which_first_calls_are_over(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(budgets, "measure_calibration_s", lambda: 0.2)
    budget = budget_of(tmp_path, ingest=2.0, gnet=3.0)
    first = budget.make_chooser(LOG, 0)
    before = first.predict_s(first._table.points[2])
    assert first.next_stage()
    first.record_stage("ingest", 1.0, cached=False)
    second = budget.make_chooser(LOG, 1)
    # Ingest has run in this process and GNet has not; the machine takes twice the table's seconds.
    assert second._first_call_s == {"gnet": 3.0}
    assert second.predict_s(second._table.points[2]) == pytest.approx(2 * (before - 1.06 * 2.0))


def test_a_chunk_that_failed_leaves_first_calls_to_the_next(tmp_path: Path) -> None:
    budget = budget_of(tmp_path, gnet=3.0)
    assert budget.make_chooser(LOG, 0).next_stage()
    assert budget.make_chooser(LOG, 1)._first_call_s == {"gnet": 3.0}


@pytest.mark.parametrize(("width", "factor"), [(640, 4.0), (160, 1.0)])
def test_larger_images_take_longer_and_smaller_ones_are_not_trusted_to(width: int, factor: float) -> None:
    sized = load_configuration("small", settings=[f"ingest.width_px={width}", f"ingest.height_px={width * 9 // 16}"])
    by = [Chooser(replace(TABLE, first_call_s={}), config, Frozen(60.0), 1.0, lambda: 1.0) for config in (SMALL, sized)]
    overhead_s = 0.6
    gnet_s, sized_s = (chooser._stage_s(POINTS[-1], "gnet") - overhead_s for chooser in by)
    assert sized_s == pytest.approx(factor * gnet_s)
    # Reading a log takes what it takes, however small its images become.
    assert by[0]._stage_s(POINTS[-1], "ingest") == by[1]._stage_s(POINTS[-1], "ingest")


def test_a_table_of_other_settings_is_refused(tmp_path: Path) -> None:
    own = ["gnet.views_per_iteration=5", "evaluate.every=4", "enet.snapshots=0"]
    table = str(written(tmp_path / "cost.parquet", settings=json.dumps(own)))
    with pytest.raises(ConfigError, match=r"measured with gnet\.views_per_iteration=5, which.*--set"):
        resolve_table(table, "demo", load_configuration("demo"))
    # What only evaluation or its curve sees costs no budget anything.
    assert resolve_table(table, "demo", load_configuration("demo", settings=own[:1])).settings == (own[0],)


@pytest.mark.parametrize(
    "setting",
    [
        "gnet.method=standard_3dgs",
        "fnet.max_network_px=null",
        "enet.novel_views_per_iteration=9",
        "ingest.source_every=1",
    ],
)
def test_settings_that_take_much_longer_than_the_table_says_are_refused(tmp_path: Path, setting: str) -> None:
    table = str(written(tmp_path / "cost.parquet", preset="hd"))
    key = setting.partition("=")[0]
    with pytest.raises(ConfigError, match=rf"measured without {key}, which.*--table"):
        resolve_table(table, "hd", load_configuration("hd", settings=[setting]))
    # Weights and seeds take no time.
    assert resolve_table(table, "hd", load_configuration("hd", settings=["gnet.seed=5"])).points


def test_a_table_of_another_image_size_serves(tmp_path: Path) -> None:
    own = ["ingest.width_px=160", "ingest.height_px=90"]
    path = written(tmp_path / "cost.parquet", settings=json.dumps(own))
    demo = load_configuration("demo")
    table = resolve_table(str(path), "demo", demo)
    assert (table.pixels, table.settings) == (160 * 90, ())
    by = Chooser(table, demo, Frozen(60.0), 1.0, lambda: 1.0)
    # Four times the pixels.
    measured_s = table.points[0].seconds["gnet"]
    assert by._stage_s(table.points[0], "gnet") == pytest.approx(4 * measured_s + STAGE_OVERHEAD_S)


@pytest.mark.parametrize("setting", ["enet.learning_rates=null", "enet.learning_rates.means=0.05"])
def test_a_table_that_sets_a_section_leaves_no_key_of_it_to_the_user(tmp_path: Path, setting: str) -> None:
    rows = [
        table_row("", (), "enet", 2.0, 25.0),
        table_row("slow", ("enet.learning_rates={means: 0.1, log_scales: 0.1}",), "enet", 1.0, 24.0),
    ]
    path = tmp_path / "cost.parquet"
    facts = {"base": "small", "judged": "psnr", "calibration_s": "0.1", "cold_seconds": "{}", "machine": "somewhere"}
    write_settings(path, summarise_settings(rows), facts)
    with pytest.raises(ConfigError, match=r"enet\.learning_rates\S* is what a budget decides"):
        resolve_table(str(path), "small", load_configuration("small", settings=[setting]))
    assert resolve_table(str(path), "small", load_configuration("small")).points


@pytest.mark.parametrize("settings", ["7", "not JSON", '["gnet.iteration=3"]'])
def test_damaged_settings_of_a_table_are_an_error(tmp_path: Path, settings: str) -> None:
    with pytest.raises(ConfigError):
        load_cost_table(written(tmp_path / "cost.parquet", settings=settings), "demo")


def unjudged(metrics: Mapping[str, float]) -> list[dict[str, object]]:
    rows = [table_row("", (), "gnet", 2.0, 0.0), table_row("short", ("gnet.iterations=1",), "gnet", 1.0, 0.0)]
    return [row | {"metrics": dict(metrics)} for row in rows]


def test_a_sweep_whose_preset_failed_has_a_picture() -> None:
    rows = unjudged({"interpolation/psnr": 20.0})[1:]
    assert draw_sweep(summarise_settings(rows), PSNR, "no preset").std() > 0


def test_labels_of_settings_at_one_point_do_not_hide_each_other() -> None:
    figure = Figure()
    canvas = FigureCanvasAgg(figure)
    axes = figure.subplots()
    for text, place in (("gate 0.05", 0.2), ("gate 0.2", 0.2), ("off", 0.8)):
        axes.annotate(text, (place, place))
    canvas.draw()
    plot._remove_hidden_labels(axes)
    assert [label.get_text() for label in axes.texts] == ["gate 0.05", "off"]


def test_labels_stay_in_their_panel() -> None:
    figure = Figure()
    canvas = FigureCanvasAgg(figure)
    axes = figure.subplots(2)[0]
    axes.set(xlim=(0, 1), ylim=(0, 1))
    for place, side in ((0.02, "right"), (0.5, "left"), (0.99, "left")):
        offset = {"xytext": (4, 3), "textcoords": "offset points", "ha": side}
        axes.annotate("160000, GNet 144,\nENet 32", (place, 0.95), **offset)
    canvas.draw()
    middle = axes.texts[1].get_position()[0]
    plot._move_labels_inside(axes)
    canvas.draw()
    panel = axes.bbox.padded(0.5)
    for label in axes.texts:
        box = label.get_window_extent()
        assert panel.x0 <= box.x0 < box.x1 <= panel.x1
        assert panel.y0 <= box.y0 < box.y1 <= panel.y1
    assert axes.texts[1].get_position()[0] == middle


def test_a_sweep_without_held_out_images_has_a_picture_and_its_table_is_refused(tmp_path: Path) -> None:
    summaries = summarise_settings(unjudged({"shift_3m/kernel": 0.1, "shift_3m/n": 4.0}))
    assert math.isnan(summaries[0].values["psnr"].average)
    assert draw_sweep(summaries, PSNR, "without held-out images").shape[2] == 3
    path = tmp_path / "cost.parquet"
    facts = {"base": "demo", "judged": "psnr", "calibration_s": "0.1", "cold_seconds": "{}", "machine": "somewhere"}
    write_settings(path, summaries, facts)
    with pytest.raises(ConfigError, match=r"no setting of this table has a .*PSNR"):
        load_cost_table(path, "demo")
