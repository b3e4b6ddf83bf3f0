"""The report: complete, self-contained, escaped, light to import, honest about what is missing."""

from __future__ import annotations

import base64
import io
import re
import subprocess
import sys
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from flows.reconstruction.report.accuracy_curve import accuracy_curve
from flows.reconstruction.report.error_maps import error_palette, make_error_map
from flows.reconstruction.report.lineage_graph import build_lineage_rows, draw_lineage
from flows.reconstruction.report.metric_table import SCORED_STAGES, build_headline, build_metric_rows
from flows.reconstruction.report.range_plot import plot_range_curve
from flows.reconstruction.report.viewpoints import build_viewpoints
from flows.reconstruction.report.writing import write_report
from flows.reconstruction.run_summary import ChunkSummary, Origin, RangeSummary, RunSummary, StageSummary
from genre_tasks.effects.types import Decision
from storage.codecs.png import encode_png

PNG = bytes.fromhex(
    "89504e470d0a1a0a0000000d4948445200000001000000010802000000907753de0000000c4944415408d763f8cfc000000301010018dd8db0"
    "0000000049454e44ae426082"
)


class Reader(HTMLParser):
    """Checks that tags nest, and gathers text, tags and addresses."""

    void = frozenset({"meta", "img", "br", "link", "input", "hr"})

    def __init__(self, html: str) -> None:
        super().__init__()
        self.open: list[str] = []
        self.text: list[str] = []
        self.tags: list[str] = []
        self.addresses: list[str] = []
        self.feed(html)
        self.close()
        assert not self.open

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append(tag)
        self.addresses += [v or "" for k, v in attrs if k in ("src", "href")]
        if tag not in self.void:
            self.open.append(tag)

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append(tag)

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        if not self.open or self.open[-1] not in ("style", "title", "script"):
            self.text.append(data.strip())


def scene(stage: str, psnr: float, kernel: float, **fields) -> StageSummary:
    metrics = {
        "interpolation/psnr": psnr,
        "interpolation/n": 45.0,
        "shift_3m/psnr": psnr - 4,
        "shift_3m/kernel": kernel,
        "shift_3m/n": 30.0,
        "shift_10m/kernel": kernel,
    }
    return StageSummary(stage, f"{stage}-key-0123456789", False, 10.0, 500.0, metrics, **fields)


def chunk(number: int = 0) -> ChunkSummary:
    truth = {"0m_front_camera_05.truth": PNG, "3m_left_front_camera_04.truth": PNG}
    pictures = {"0m_front_camera_05": PNG, "3m_left_front_camera_04": PNG} | truth
    fixed = {"shift_3m/psnr": 23.0, "shift_3m/render_psnr": 20.0, "shift_3m/n": 30.0}
    stages = (
        StageSummary("ingest", "i" * 64, True, 2.5, 100.0),
        scene("initial", 17.0, 0.004, curve=((0.0, 17.1),)),
        scene("gnet", 24.0, 0.002, pictures=pictures, curve=((2.0, 20.0), (10.0, 24.1))),
        StageSummary("fnet", "f" * 64, False, 5.0, 900.0, fixed, {"3m_left_front_camera_04": PNG}),
        scene("enet", 23.8, 0.001, curve=((3.0, 23.9), (6.0, 24.0)), intervals={"shift_3m/kernel": (-0.001, 0.003)}),
        StageSummary("evaluate/gnet", "e" * 64, True, 7.25, 300.0),
    )
    return ChunkSummary(number, stages, ("missing_sweep: frame 28 <has> no sweep & none follows",))


def run(*chunks: ChunkSummary) -> RunSummary:
    log = 'synthetic:street?seed=1&x=<script>alert("1")</script>'
    return RunSummary("0123456789ab", log, "demo", "a/store", chunks or (chunk(),), {"gnet.iterations": (24, 8)})


def test_writes_one_self_contained_page(tmp_path: Path) -> None:
    path = write_report(tmp_path / "deep" / "report.html", run(chunk(0), chunk(3)))
    assert path == tmp_path / "deep" / "report.html" and list(path.parent.iterdir()) == [path]
    html = path.read_text(encoding="utf-8")
    page = Reader(html)
    assert all(a.startswith(("data:image/", "#chunk-")) for a in page.addresses)
    assert not re.search(r"https?://|@import|url\((?!#)", html)
    # The page's script is the only one: that of the log's name is text.
    assert page.tags.count("script") == 1 and "alert(" not in html.partition("<script>")[2]
    text = " ".join(page.text)
    for expected in (
        'x=<script>alert("1")</script>',
        "demo",
        "a/store",
        "0123456789ab",
        "Chunk 3",
        "Chunk 3 24.00 dB 23.80 dB",
        "gnet.iterations = 8",
        "frame 28 <has> no sweep & none follows",
        "4 of 12",
        "from cache",
        "computed",
        "7.2",
        "+7.00 against initial",
        "−0.0010 … 0.0030",
        "3 m to the left · front camera · frame 4",
        "the fixer works beside the path",
    ):
        assert expected in text, expected
    # Five pictures, the errors of those with a truth, and the two layers of each slider.
    assert page.tags.count("img") == 2 * (5 + 3 + 2 * 2) and page.tags.count("svg") == 2


def test_the_same_run_writes_the_same_bytes(tmp_path: Path) -> None:
    one, two = write_report(tmp_path / "a.html", run()), write_report(tmp_path / "b.html", run())
    assert one.read_bytes() == two.read_bytes()


def test_best_is_marked_in_the_right_direction() -> None:
    rows = build_metric_rows({s.stage: s for s in chunk().stages if s.stage in SCORED_STAGES})
    best = {}
    group = ""
    for row in rows:
        group = row.group or group
        best[group, row.label] = [SCORED_STAGES[i] for i, c in enumerate(row.values) if c is not None and c.best]
    assert best["Held-out frames", "PSNR, dB"] == ["gnet"]
    assert best["3 m to the side", "PSNR, dB"] == ["fnet"]
    assert best["3 m to the side", "Kernel"] == ["enet"]
    assert best["3 m to the side", "PSNR, dB of the renders given"] == []
    assert [r.group for r in rows if r.group] == ["Held-out frames", "3 m to the side", "10 m to the side"]
    assert rows[0].values[2] is None and rows[0].values[1].text == "24.00"


def test_stages_measured_on_fewer_images_and_ties_win_nothing() -> None:
    few = StageSummary("fnet", "f", False, 1, 1, {"shift_3m/psnr": 99.0, "shift_3m/n": 8.0})
    rows = build_metric_rows({"gnet": scene("gnet", 24.0, 1.0), "enet": scene("enet", 24.0, 0.5), "fnet": few})
    row = next(r for r in rows if r.group == "3 m to the side")
    assert not any(c.best for c in row.values if c is not None)
    nan = build_metric_rows({"gnet": scene("gnet", float("nan"), 1.0), "enet": scene("enet", 20.0, 1.0)})
    assert nan[0].values[1].text == "not finite" and not any(c.best for c in nan[0].values if c is not None)


def test_pictures_say_what_is_missing() -> None:
    on_path, beside = build_viewpoints(chunk())
    assert on_path.label == "On the path · front camera · frame 5" and beside.label.startswith("3 m to the left")
    assert [p.label for p in on_path.pictures] == ["Truth", "Initial", "GNet", "Fixed", "ENet"]
    assert [bool(p.image) for p in on_path.pictures] == [True, False, True, False, False]
    assert [bool(p.image) for p in beside.pictures] == [True, False, True, True, False]
    assert (beside.before, beside.after) == ("GNet", "Fixed") and (on_path.before, on_path.after) == ("GNet", "Truth")
    real = ChunkSummary(0, (StageSummary("gnet", "g", False, 1, 1, {}, {"3m_right_left_camera_10": PNG}),))
    (view,) = build_viewpoints(real)
    assert view.label == "3 m to the right · left camera · frame 10"
    assert view.pictures[0].image is None and "no true image" in view.pictures[0].why
    assert not any(picture.error for picture in view.pictures)


def test_an_error_map_shows_where_and_how_much() -> None:
    truth = np.full((4, 6, 3), 100, np.uint8)
    render = truth.copy()
    render[:, 3:] += 51  # a fifth of full brightness: the end of the scale
    error = make_error_map(encode_png(render), encode_png(truth))
    assert error is not None and abs(error.mean - 0.1) < 1e-9 and abs(error.psnr + 10 * np.log10(0.02)) < 1e-9
    with Image.open(io.BytesIO(base64.b64decode(error.image.url.partition(",")[2]))) as image:
        colors = np.asarray(image.convert("RGB"))
    assert (colors[:, :3] == error_palette()[0]).all() and (colors[:, 3:] == error_palette()[-1]).all()
    same = make_error_map(encode_png(truth), encode_png(truth))
    assert same is not None and same.words == "no difference"
    assert make_error_map(encode_png(truth), encode_png(truth[:2])) is None


def test_lineage_names_all_inputs_and_draws_the_nearest() -> None:
    inputs = {"ingest": {"log": "l"}, "initial": {"ingest": "i"}, "gnet": {"ingest": "i", "initial": "n"}}
    stages = [
        StageSummary(name, name, False, 1, 1, origin=Origin(of, f"{name}-payload", 2**21, "2026-01-02T03:04:05", "c"))
        for name, of in inputs.items()
    ]
    rows = build_lineage_rows(stages)
    assert [row.made_from for row in rows] == [("log",), ("ingest",), ("ingest", "initial")]
    assert (rows[0].size, rows[0].made_at) == ("2 MiB", "2026-01-02 03:04:05")
    graph = draw_lineage(stages)
    assert graph is not None and graph.words == "initial from ingest; gnet from initial" and len(graph.edges) == 2
    assert [box[4] for box in graph.boxes] == list(inputs)
    assert draw_lineage([StageSummary("gnet", "k", False, 1, 1)]) is None


def test_a_range_has_its_left_on_the_left() -> None:
    found = RangeSummary("enet", 1.9, 1.5, 2.0, 20.0, ((-2.0, 18.0, False), (0.0, 24.0, True), (2.0, 21.0, False)))
    plot = plot_range_curve(found)
    assert plot is not None and plot.band[0] < plot.points[1][0] < plot.band[1]
    assert plot.points[0][0] > plot.points[2][0] and plot.points[1][1] < plot.limit_y < plot.points[0][1]
    assert plot_range_curve(RangeSummary("enet", 1.9, 1.5, 2.0)) is None


def test_effects_range_lineage_and_scene_are_in_the_page(tmp_path: Path) -> None:
    decision = Decision("rolling_shutter", "p", 4.5, "px", 1.0, "on", "mark", "because <it> moves", "a pose a row")
    origin = Origin({"log": "l"}, "d" * 64, 4096, "2026-01-02T03:04:05+00:00", "c" * 64)
    stages = (StageSummary("ingest", "i" * 64, True, 1, 1, origin=origin, contents={"frames": 1200, "image": "4 × 3"}),)
    full = ChunkSummary(0, stages, effects=(decision,), reliable_range=RangeSummary("enet", 1.9, 5.0, 5.0))
    (tmp_path / "scene.html").write_text("a scene")
    page = Reader(write_report(tmp_path / "r.html", run(full)).read_text())
    text = " ".join(page.text)
    for expected in ("rolling shutter", "reported only", "set by hand", "4.5 px (threshold 1)", "because <it> moves"):
        assert expected in text, expected
    assert "1.9 m to the left, 5.0 m or more to the right" in text and "1,200" in text and "d" * 12 in text
    assert "scene.html" in page.addresses
    (tmp_path / "scene.html").unlink()
    assert "scene.html" not in Reader(write_report(tmp_path / "r.html", run(full)).read_text()).addresses
    bare = ChunkSummary(0, stages)
    text = " ".join(Reader(write_report(tmp_path / "r.html", run(bare)).read_text()).text)
    assert "genre range 0123456789ab --chunk 0 --store a/store" in text
    assert "genre show KEY --store a/store" in text and "genre diff A B --store a/store" in text


@pytest.mark.parametrize(
    ("store", "option"), [("genre-store", ""), ("my 'store'", """ --store 'my '"'"'store'"'"''""")]
)
def test_commands_find_the_store_of_the_run(tmp_path: Path, store: str, option: str) -> None:
    bare = ChunkSummary(0, (StageSummary("ingest", "i" * 64, True, 1, 1),))
    text = Reader(write_report(tmp_path / "r.html", replace(run(bare), store=store)).read_text()).text
    assert f"genre range 0123456789ab --chunk 0{option}" in text


def test_curve_continues_where_gnet_ended() -> None:
    curve = accuracy_curve(chunk())
    gnet, enet = curve.lines
    assert [t for *_, t in gnet.points] == [
        "GNet: 17.10 dB after 0.0 s",
        "GNet: 20.00 dB after 2.0 s",
        "GNet: 24.10 dB after 10.0 s",
    ]
    assert [t.rpartition("after ")[2] for *_, t in enet.points] == ["10.0 s", "13.0 s", "16.0 s"]
    assert gnet.points[-1][:2] == enet.points[0][:2]
    assert all(48 <= x <= 628 and 16 <= y <= 256 for line in curve.lines for x, y, _ in line.points)
    assert gnet.points[0][1] > gnet.points[-1][1]  # better is higher on the page
    assert accuracy_curve(ChunkSummary(0, (scene("gnet", 20, 1),))) is None
    flat = ChunkSummary(0, (scene("gnet", 20, 1, curve=((0.0, 20.0), (5.0, 20.0))),))
    assert accuracy_curve(flat) is not None


@pytest.mark.parametrize("stages", [(), (StageSummary("ingest", "k", False, 0.0, 0.0),)])
def test_a_run_with_nothing_to_show_still_has_a_report(tmp_path: Path, stages: tuple[StageSummary, ...]) -> None:
    empty = ChunkSummary(0, stages)
    assert build_headline(empty) == []
    Reader(write_report(tmp_path / "r.html", run(empty)).read_text())


def test_needs_neither_torch_nor_prefect() -> None:
    code = (
        "import sys, pathlib, tempfile; from flows.reconstruction.report.writing import write_report; "
        "from flows.reconstruction.run_summary import *;"
        "run = RunSummary('r', 'l', 'p', 's', (ChunkSummary(0, ()),));"
        "write_report(pathlib.Path(tempfile.mkdtemp()) / 'r.html', run);"
        "assert not {'torch', 'prefect', 'numpy', 'matplotlib'} & set(sys.modules)"
    )
    subprocess.run([sys.executable, "-c", code], check=True, cwd=Path(__file__).parents[2])
