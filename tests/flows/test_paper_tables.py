"""The paper's tables: methods, rows beside the paper's, the page, and that a table goes on where it was stopped."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pyarrow.parquet as pq
import pytest
from typer.testing import CliRunner

from flows.cli.main import app
from flows.configuration import load_configuration
from flows.experiments.log_chunks import LogChunk
from flows.paper_tables.builtin_methods import BUILT_IN
from flows.paper_tables.columns import MeasuredCell, mean_over_cells
from flows.paper_tables.comparison_strips import draw_strips
from flows.paper_tables.figure import SHIFTS_M, TABLE, Kind, comparison_strips
from flows.paper_tables.flow import paper_table, write_results
from flows.paper_tables.layouts import LAYOUTS, PROTOCOL, get_layout
from flows.paper_tables.measure import Basis, list_stages, measure_cell
from flows.paper_tables.methods import Method
from flows.paper_tables.page import list_differences, render_page
from flows.paper_tables.page_sections import replace_section
from flows.paper_tables.parquet import read_cells
from flows.paper_tables.published_numbers import PAPER
from flows.paper_tables.request import CheckedRequest, TableRequest, find_unstored_methods, predict_table
from flows.paper_tables.user_methods import read_method
from flows.paper_tables.weights_slots import read_weights
from flows.pipeline.stage_runner import run_stage
from genre_tasks.errors import ConfigError, GenreError, InputError
from tests.faults.small_run import LOG, SETTINGS, Stopped, stopping

EXAMPLES = Path(__file__).resolve().parents[2] / "docs/examples"


def test_every_row_and_column_of_the_papers_tables_has_a_place() -> None:
    # Table 8 has no methods on chunks, and a flow of its own.
    assert set(LAYOUTS) | {8} == set(PAPER) == {1, 2, 3, 4, 5, 6, 7, 8}
    for number, layout in LAYOUTS.items():
        rows = PAPER[number].rows
        assert [r.paper for r in layout.rows] == list(rows)
        assert [c.paper for c in layout.columns] == list(next(iter(rows.values())))
    assert PAPER[1].rows["Ours (GNet)"]["fid_3m"] == PAPER[4].rows["GNet"]["fid_3m"] == 106.07
    for row in PAPER[5].rows.values():
        phases = row["reconstruction"] + row["fixer"] + row["distillation"]
        assert phases == pytest.approx(row["total"], abs=0.01)


@pytest.mark.parametrize("preset", ["demo", "small", "paper"])
def test_built_in_methods_are_settings_that_every_preset_takes(preset: str) -> None:
    base = load_configuration(preset, settings=PROTOCOL)
    configs = {key: m.configuration(preset, PROTOCOL) for key, m in BUILT_IN.items()}
    assert configs["gnet"] == configs["genre+"] == base
    for key, method in (("3dgs", "standard_3dgs"), ("streetgs", "street_gs"), ("g3r", "g3r"), ("difix", "street_gs")):
        assert configs[key].gnet.method == method
    assert configs["streetgs"].gnet.per_scene.depth == 0 < configs["splatad"].gnet.per_scene.depth
    assert (configs["streetgs"].effects.rolling_shutter, configs["splatad"].effects.rolling_shutter) == ("off", "auto")
    assert (configs["difix"].enet.method, configs["genre+"].enet.method) == ("adam", "learned")
    again = configs["gnet-gnet"]
    assert again.enet.weights == "builtin:gnet" and again.enet.iterations == base.gnet.iterations
    assert BUILT_IN["genre+"].configuration(preset, (*PROTOCOL, "gnet.method=adam", "enet.method=adam")) == base
    short = (*PROTOCOL, "gnet.per_scene.iterations=9")
    assert BUILT_IN["genre+"].configuration(preset, short) == base  # it has no per-scene part: its stages are shared
    assert BUILT_IN["splatad"].configuration(preset, short).gnet.per_scene.iterations == 9
    assert again.gnet == base.gnet and again.enet.loss == base.enet.loss


def test_a_setting_can_take_its_value_from_the_configuration_before_it() -> None:
    method = Method("twice as many", ("gnet.iterations=5", "enet.iterations={gnet.iterations}"))
    assert method.configuration("small", ()).enet.iterations == 5
    with pytest.raises(ConfigError, match=r"no configuration key 'gnet.iteration'"):
        Method("wrong", ("enet.iterations={gnet.iteration}",)).configuration("small", ())


def test_a_method_of_ones_own_is_a_small_file(tmp_path: Path) -> None:
    file = tmp_path / "own.yaml"
    file.write_text("name: GNet, 24 iterations\nsettings: [gnet.iterations=24]\nend: gnet\nnote: shorter\n")
    method = read_method(file, "small")
    assert method == Method("GNet, 24 iterations", ("gnet.iterations=24",), "gnet", "shorter")
    assert [r.label for r in get_layout(4, [method]).rows][-1] == "GNet, 24 iterations"
    assert get_layout(4, [method]).rows[-1].paper == ""
    with pytest.raises(ConfigError, match=r"ends at gnet.*takes methods that end at fnet"):
        get_layout(3, [method])
    with pytest.raises(ConfigError, match="two methods have one name"):
        get_layout(4, [method, method])


@pytest.mark.parametrize(("name", "end"), [("gnet", "gnet"), ("genre", "enet")])
def test_the_examples_of_methods_are_the_preset_fine(name: str, end: str) -> None:
    method = read_method(EXAMPLES / f"method_{name}_fine.yaml", "small")
    assert method.end == end
    assert method.configuration("small", ()) == load_configuration("fine")


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("settings: [gnet.iterations=24]", "has no name"),
        ("name: GNet", "built-in method is called 'GNet'"),
        ("name: a\nsetting: []", "no 'setting'.*Did you mean 'settings'"),
        ("name: a\nsettings: gnet.iterations=2", "no list of strings"),
        ("name: a\nsettings: [gnet.iteration=2]", r"no configuration key.*Did you mean 'gnet.iterations'"),
        ("name: a\nend: initial", "ends at 'initial'"),
        ("name: [", "not YAML"),
        ("- a", "expected name, settings, end"),
    ],
)
def test_mistakes_in_a_methods_file_are_named_with_the_file(text: str, said: str, tmp_path: Path) -> None:
    file = tmp_path / "own.yaml"
    file.write_text(text)
    with pytest.raises(ConfigError, match=f"(?s){said}") as caught:
        read_method(file, "small")
    assert "own.yaml" in str(caught.value)
    with pytest.raises(ConfigError, match="cannot be read"):
        read_method(tmp_path / "other.yaml", "small")


def test_weights_are_given_by_name_and_a_fixers_inputs_are_checked(tmp_path: Path) -> None:
    fixer = tmp_path / "fnet.safetensors"
    fixer.write_bytes(b"")
    (tmp_path / "fnet.json").write_text(json.dumps({"architecture": {"inputs": ["render", "reference"]}}))
    given = read_weights([f"difix={fixer}", f"enet-g3r={fixer}"])
    method = BUILT_IN["difix"].with_weights(given)
    assert method.configuration("small", ()).fnet.weights == str(fixer)
    assert "fnet.safetensors" in method.note and "stands in" not in method.note
    assert "stands in" in BUILT_IN["difix"].with_weights({}).note
    assert not BUILT_IN["fixer-difix"].with_weights(given).needs_weights
    with pytest.raises(InputError, match=r"trained with render, reference.*--inputs reference\+lidar"):
        read_weights([f"streetcrafter={fixer}"])
    (tmp_path / "fnet.json").write_text(json.dumps({"architecture": {}}))
    with pytest.raises(InputError, match="trained with all inputs"):
        read_weights([f"difix={fixer}"])
    with pytest.raises(InputError, match="no such weights"):
        read_weights([f"difix={tmp_path / 'none'}"])
    with pytest.raises(ConfigError, match="Did you mean 'difix'"):
        read_weights(["difx=x"])


def cell(method: str, psnr: float, kernel: float, chunk: int = 0, **seconds: float) -> MeasuredCell:
    metrics = {"interpolation/psnr": psnr, "interpolation/n": 45.0, "shift_3m/n": 120.0}
    metrics |= {f"shift_{n}m/kernel": kernel * n for n in range(1, 6)}
    own = {"ingest": 60.0, "initial": 6.0, "gnet": 30.0} | seconds
    return MeasuredCell(
        method, "synthetic:street?seed=1001", chunk, own, dict.fromkeys(own, math.nan), metrics, 1000, 0
    )


def plan(number: int, *places: int) -> CheckedRequest:
    request = TableRequest(number, ("synthetic:street?seed=1001",), chunks=tuple(places or (0,)))
    return request.check()


def test_means_are_over_places_and_only_of_what_all_have() -> None:
    column = LAYOUTS[1].columns[0]
    assert mean_over_cells(column, [cell("GNet", 20.0, 0.1), cell("GNet", 24.0, 0.1)]) == 22.0
    lacking = replace(cell("GNet", 20.0, 0.1), metrics={})
    assert math.isnan(mean_over_cells(column, [cell("GNet", 20.0, 0.1), lacking])) and math.isnan(
        mean_over_cells(column, [])
    )


def test_the_page_has_the_papers_numbers_beside_and_says_what_differs() -> None:
    layout = plan(1).layout
    cells = [cell("GNet", 29.4, 0.1), cell("3DGS", 25.0, 0.3, enet=24.0), cell("StreetGS-style", 25.5, 0.2)]
    config = load_configuration("small", settings=["gnet.per_scene.iterations=3000"])
    apart = list_differences(layout, config, "synthetic", 1)
    text = render_page(layout, cells, {"SplatAD-style": "it failed: no memory"}, ["* commit: abc"], apart, "synthetic")
    first = text.split("Measured beside it")[0]
    rows = {line.split(" | ")[0]: line.split(" | ") for line in first.splitlines() if line.startswith("| ")}
    head = rows["| method"]
    assert head[3] == "kernel @1m / FID @1m" and head[-1].startswith("minutes")
    assert rows["| GNet"][1] == "**29.40** / 23.56" and rows["| GNet"][-1] == "**0.60** / 0.960 |"
    assert rows["| 3DGS"][1] == "25.00 / 23.45" and rows["| 3DGS"][-1] == "1.00 / 41.90 |"
    assert rows["| GNet"][5] == "**0.300** / 106.07"
    assert rows["| SplatAD-style"][1] == "not measured / 24.93"
    for said in (
        "no memory",
        "3000 iterations, of 30000",
        "320×180",
        "FID is not measured",
        "`--set evaluate.lpips=vgg`",
        "synthetic",
        "FNet with all inputs stands in",
        "commit: abc",
    ):
        assert said in text
    paper = load_configuration("paper")
    assert not any("iterations" in t for t in list_differences(layout, paper, "pandaset", 10))


def test_fid_takes_the_papers_columns_once_it_was_measured() -> None:
    planned = plan(4)
    kernel = cell("GNet", 29.4, 0.1)
    both = replace(kernel, metrics=dict(kernel.metrics) | {f"shift_{n}m/fid": 80.0 + n for n in range(1, 6)})
    config = load_configuration("small", settings=["evaluate.inception=i.pt"])
    apart = list_differences(planned.layout, config, "synthetic", 1)
    text = render_page(planned.layout, [both], {}, [], apart, "synthetic")
    assert "| FID @1m | FID @2m |" in text and "| 81.00 / 70.04 | 82.00 / 86.43 |" in text
    assert "not measured: weights" not in text and "FID is biased" in text
    assert "| kernel @1m |" in text.split("Measured beside it")[1]
    assert "FID @1m |" in render_page(planned.layout, [kernel], {}, [], apart, "synthetic")
    assert "81.00" not in render_page(planned.layout, [kernel], {}, [], apart, "synthetic")


def test_rows_without_weights_are_not_measured_and_say_what_to_give() -> None:
    missing = plan(3).missing
    assert set(missing) == {"StreetCrafter-V's inputs", "Difix3D's inputs"}
    assert "--weights difix=PATH" in missing["Difix3D's inputs"]
    assert set(plan(2).missing) == {"G3R-style + GenRe (fine-tuned)"} and not plan(1).missing
    rows = predict_table(plan(3))
    assert [r["seconds"] > 0 for r in rows] == [False, False, True]


def test_a_section_is_written_anew_and_the_others_stay(tmp_path: Path) -> None:
    file = tmp_path / "tables.md"
    for number, on, text in ((4, "b", "four"), (1, "b", "one"), (4, "b", "again"), (5, "a", "five"), (4, "a", "real")):
        replace_section(file, number, on, text)
    text = file.read_text()
    assert "four" not in text
    places = [text.index(word) for word in ("# The paper's tables", "\none", "\nreal", "\nagain", "\nfive")]
    assert places == sorted(places)
    replace_section(file, 1, "b", "one")
    assert file.read_text() == text
    file.write_text(text.replace("<!-- end of table 4 on a -->", ""))
    with pytest.raises(InputError, match="does not hold one section"):
        replace_section(file, 4, "a", "more")
    assert [f.name for f in tmp_path.iterdir()] == ["tables.md"]


def test_the_files_say_the_same(tmp_path: Path) -> None:
    request = TableRequest(
        2,
        ("synthetic:street?seed=1001",),
        chunks=(0,),
        out=str(tmp_path),
        into=str(tmp_path / "all.md"),
        settings=("gnet.iterations=7",),
        remarks=("measured at night",),
    )
    planned = request.check()
    write_results(request, planned, [cell("3DGS", 20.0, 0.7)], planned.missing)
    files = write_results(request, planned, [cell("3DGS", 25.0, 0.3)], planned.missing)  # in the place of the first
    assert [Path(f).name for f in files] == ["table2_synthetic.parquet", "table2_synthetic.md", "all.md"]
    table = pq.read_table(files[0]).to_pydict()
    assert table["method"] == [r.label for r in planned.layout.rows]
    assert table["log"][0] == "synthetic:street?seed=1001" and table["chunk"] == [0, None, None, None, None]
    assert "--weights enet-g3r=PATH" in table["not_measured"][4]
    assert json.loads(table["metrics"][0])["shift_3m/kernel"] == pytest.approx(0.9)
    assert json.loads(table["cpu_seconds"][0])["gnet"] is None
    assert json.loads(table["paper"][1])["fid_3m"] == 99.69
    cells, missing, facts = read_cells(Path(files[0]))
    assert [(c.method, c.chunk, c.metrics["shift_3m/kernel"]) for c in cells] == [("3DGS", 0, pytest.approx(0.9))]
    assert math.isnan(cells[0].cpu_seconds["gnet"]) and missing == planned.missing
    assert facts["command"] == f"`{request.command}`"
    text = Path(files[1]).read_text()
    assert text.strip() in Path(files[2]).read_text()
    for said in ("0.900 / 154.21", "measured at night", "genre table 2", "--set gnet.iterations=7"):
        assert said in text
    assert "| 3DGS + GenRe | – / 57.32 |" in text


TABLE_SETTINGS = (*(s for s in SETTINGS if "snapshots" not in s), "gnet.per_scene.iterations=12")


def test_a_table_goes_on_where_it_was_stopped_and_methods_share_stages(tmp_path: Path) -> None:
    basis, layout, place = Basis("demo", TABLE_SETTINGS, str(tmp_path)), LAYOUTS[4], LogChunk(LOG, 0)
    computed, counted = stopping(after=6)
    with pytest.raises(Stopped):
        for row in layout.rows:
            measure_cell(basis, layout, row.method, place, counted)
    assert computed == ["ingest", "effects", "initial", "gnet", "evaluate/gnet", "novel_views"]
    computed.append("stopped here")
    cells = [measure_cell(basis, layout, row.method, place, counted) for row in layout.rows]
    assert computed[7:] == ["fnet", "enet", "evaluate/enet", "enet", "evaluate/enet"]
    gnet, again, enhanced = cells
    assert "enet" not in gnet.seconds and again.seconds["gnet"] == gnet.seconds["gnet"] > 0
    kernels = [c.metrics["shift_3m/kernel"] for c in cells]
    assert len(set(kernels)) == 3 and all(math.isfinite(k) for k in kernels)
    assert enhanced.fixed_views == 4 and gnet.fixed_views == 0  # two source frames, both sides
    request = TableRequest(4, (LOG,), "demo", str(tmp_path), settings=TABLE_SETTINGS)
    rows = predict_table(request.check())
    assert [r["seconds"] for r in rows] == [0.0] * 3 and rows[0]["cached"] == "5 of 5 stages"
    assert find_unstored_methods(request.check()) == {}
    longer = replace(request, settings=(*TABLE_SETTINGS, "enet.seed=7")).check()
    assert find_unstored_methods(longer)["GNet → FNet → ENet"] == f"the store has no enet of {place} yet."
    assert set(find_unstored_methods(longer)) == {"GNet → FNet → GNet", "GNet → FNet → ENet"}
    before = len(computed)
    assert [measure_cell(basis, layout, row.method, place, counted) for row in layout.rows] == cells
    assert len(computed) == before


def test_per_scene_rows_run_to_their_end_and_times_fall_into_phases(tmp_path: Path) -> None:
    basis, layout, place = (
        Basis("demo", (*TABLE_SETTINGS, "evaluate.distributions=false"), str(tmp_path)),
        LAYOUTS[5],
        LogChunk(LOG, 0),
    )
    method = replace(BUILT_IN["difix"], settings=(*BUILT_IN["difix"].settings, "enet.iterations=3"))
    found = measure_cell(basis, layout, method, place, run_stage)
    assert found.metrics == {} and list_stages(layout, method)[-1] == "enet"
    by = {c.key: c.read(found) for c in layout.columns}
    assert by["reconstruction"] == (found.seconds["initial"] + found.seconds["gnet"]) / 60
    assert by["total"] == pytest.approx(by["reconstruction"] + by["fixer"] + by["distillation"]) and by["fixer"] > 0
    splatad = measure_cell(basis, LAYOUTS[1], BUILT_IN["splatad"], place, run_stage)
    streetgs = measure_cell(basis, LAYOUTS[1], BUILT_IN["streetgs"], place, run_stage)
    assert splatad.metrics["interpolation/psnr"] != streetgs.metrics["interpolation/psnr"]


def test_the_command_lists_what_it_would_run_and_refuses_what_it_does_not_know(tmp_path: Path) -> None:
    told = ["table", "4", LOG, "--preset", "demo", "--store", str(tmp_path), "--dry-run"]
    done = CliRunner().invoke(app, told, terminal_width=200)
    assert done.exit_code == 0, done.output
    assert "GNet → FNet" in done.output and "minutes" in done.output
    wrong: list[tuple[list[str], str]] = [
        (["table", "9", LOG], "there is no table 9"),
        (["table", "7", LOG], "table 7 asks a detector"),
        (["table", "4", LOG, "--chunks", "9"], "no chunk 9"),
        (["figure", "recons", LOG, "--out", "x.png"], "no figure 'recons'"),
        (["figure", "recon", LOG, "--out", "x.jpg"], "Give --out x.png"),
        (["table", "4", LOG, "--method", str(tmp_path / "none.yaml")], "cannot be read"),
    ]
    for arguments, said in wrong:
        with pytest.raises(GenreError, match=said):
            CliRunner().invoke(app, arguments, catch_exceptions=False)


def test_logs_of_several_datasets_make_no_table(monkeypatch: pytest.MonkeyPatch) -> None:
    both = ("synthetic:street?seed=1001", "synthetic:street?seed=1002")
    assert plan(4).dataset == "synthetic"
    assert len(TableRequest(4, both, chunks=(0,)).check().places) == 2
    monkeypatch.setattr("flows.paper_tables.request.cached_log", lambda uri: SimpleNamespace(dataset=uri[-4:]))
    with pytest.raises(ConfigError, match=r"several datasets \(1001, 1002\).*--into keeps a section for each"):
        TableRequest(4, both, chunks=(0,)).check()


@pytest.mark.parametrize(
    ("kind", "labels"),
    [("recon", ["3DGS", "GNet", "the truth"]), ("fixers", ["what they are given", "FNet", "the truth"])],
)
def test_a_figure_has_a_row_for_each_method_and_the_truth(kind: Kind, labels: list[str], tmp_path: Path) -> None:
    request = TableRequest(TABLE[kind], (LOG,), "demo", str(tmp_path), settings=TABLE_SETTINGS)
    planned = request.check()
    few = tuple(r for r in planned.layout.rows if r.label in (*labels, *planned.missing))
    found = comparison_strips(kind, replace(planned, layout=replace(planned.layout, rows=few)), run_stage)
    assert [s.label for s in found] == labels
    for strip in found:
        assert [i.shape for i in strip.images] == [(36, 64, 3)] * len(SHIFTS_M[kind])
        assert not np.array_equal(strip.images[0], strip.images[-1])
    assert not np.array_equal(found[0].images[0], found[1].images[0])
    picture = draw_strips(found, "a street")
    assert picture.dtype == np.uint8 and picture.shape[1] > 64 * len(SHIFTS_M[kind])
    with pytest.raises(InputError, match="no source image of camera back at frame"):
        comparison_strips(kind, planned, run_stage, camera="back")
    with pytest.raises(ConfigError, match="no image is fixed at 1, 2 m"):
        comparison_strips("fixers", replace(request, settings=("novel_views.shifts_m=[3.0]",)).check(), run_stage)


def test_the_flow_leaves_out_what_fails_and_says_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from prefect.testing.utilities import prefect_test_harness

    file = tmp_path / "own.yaml"
    file.write_text("name: with a shutter\nsettings: [effects.rolling_shutter=on]\nend: gnet\n")
    warmed: list[str] = []
    monkeypatch.setattr("flows.paper_tables.flow.warm_up", lambda basis, layout: warmed.append(basis.preset))
    # One row that succeeds is enough.
    short = replace(LAYOUTS[4], rows=LAYOUTS[4].rows[:1])
    monkeypatch.setattr("flows.paper_tables.layouts.LAYOUTS", {4: short})

    def run() -> dict[str, Any]:
        return paper_table(
            4,
            [LOG],
            "demo",
            str(tmp_path / "store"),
            settings=list(TABLE_SETTINGS),
            methods=[str(file)],
            out=str(tmp_path / "out"),
            into=str(tmp_path / "tables.md"),
        )

    with prefect_test_harness(server_startup_timeout=120):
        done = run()
        first = (tmp_path / "tables.md").read_text()
        monkeypatch.setattr("flows.paper_tables.layouts.LAYOUTS", {4: replace(LAYOUTS[4], rows=())})
        with pytest.raises(GenreError, match="readout"):  # nothing is left
            run()
    assert done["failed"] == ["with a shutter"] and done["cells"] == 1 and warmed[0] == "demo"
    assert "| with a shutter | not measured |" in first and "it failed: " in first
    assert (tmp_path / "tables.md").read_text() == first
    table = pq.read_table(done["files"][0]).to_pydict()
    assert table["method"][-1] == "with a shutter" and "readout" in table["not_measured"][-1]
