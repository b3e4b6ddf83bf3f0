"""The report: complete, self-contained, escaped, light to import, honest about what is missing."""

from __future__ import annotations

import re
import subprocess
import sys
from html.parser import HTMLParser
from pathlib import Path

import pytest

from flows.reconstruction.report import write_report
from flows.reconstruction.report_curve import accuracy_curve
from flows.reconstruction.report_metrics import SCORED_STAGES, build_headline, build_metric_rows
from flows.reconstruction.report_pictures import build_picture_rows
from flows.reconstruction.run_summary import ChunkSummary, RunSummary, StageSummary

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
        if not self.open or self.open[-1] not in ("style", "title"):
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
    assert all(a.startswith(("data:image/png;base64,", "#chunk-")) for a in page.addresses)
    assert not re.search(r"https?://|@import|url\(", html)
    assert "script" not in page.tags
    text = " ".join(page.text)
    for expected in (
        'x=<script>alert("1")</script>',
        "demo",
        "a/store",
        "0123456789ab",
        "Chunk 3",
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
    assert page.tags.count("img") == 2 * 5 and page.tags.count("svg") == 2


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
    ((first, on_path), (second, beside)) = build_picture_rows(chunk())
    assert first == "On the path · front camera · frame 5" and second.startswith("3 m to the left")
    assert [p.label for p in on_path] == ["Truth", "GNet", "Fixed", "ENet"]
    assert [bool(p.url) for p in on_path] == [True, True, False, False]
    assert [bool(p.url) for p in beside] == [True, True, True, False]
    real = ChunkSummary(0, (StageSummary("gnet", "g", False, 1, 1, {}, {"3m_right_left_camera_10": PNG}),))
    ((label, pictures),) = build_picture_rows(real)
    assert label == "3 m to the right · left camera · frame 10"
    assert not pictures[0].url and "no true image" in pictures[0].why


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
        "import sys, pathlib, tempfile; from flows.reconstruction.report import write_report; "
        "from flows.reconstruction.run_summary import *;"
        "run = RunSummary('r', 'l', 'p', 's', (ChunkSummary(0, ()),));"
        "write_report(pathlib.Path(tempfile.mkdtemp()) / 'r.html', run);"
        "assert not {'torch', 'prefect', 'numpy', 'matplotlib'} & set(sys.modules)"
    )
    subprocess.run([sys.executable, "-c", code], check=True, cwd=Path(__file__).parents[2])
