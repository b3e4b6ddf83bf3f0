"""The HTML report of a run: one self-contained file, no network, readable without torch and without Prefect."""

from __future__ import annotations

import base64
import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from flows.reconstruction.report_curve import Curve, accuracy_curve
from flows.reconstruction.run_summary import ChunkSummary, RunSummary, StageSummary
from genre_tasks.atomic_path import atomic_path

NAMES = {
    "ingest": "Ingest",
    "initial": "Initial",
    "gnet": "GNet",
    "novel_views": "Novel views",
    "fnet": "FNet",
    "enet": "ENet",
}
MEASURED = ("initial", "gnet", "fnet", "enet")
"""Columns of the table of metrics."""

_PICTURES = (("gnet", "GNet"), ("fnet", "Fixed"), ("enet", "ENet"))
_TRUTH = ".truth"


@dataclass(frozen=True)
class Kind:
    """How a metric is shown: its label, which direction is better, its decimals."""

    label: str
    higher: bool
    decimals: int = 3


KINDS = {
    "psnr": Kind("PSNR, dB", True, decimals=2),
    "ssim": Kind("SSIM", True, decimals=4),
    "perceptual": Kind("Perceptual", False, decimals=4),
    "kernel": Kind("Kernel", False, decimals=4),
    "frechet": Kind("Fréchet", False, decimals=3),
}


@dataclass(frozen=True)
class Cell:
    """A value in the table of metrics."""

    text: str
    interval: str = ""
    best: bool = False


@dataclass(frozen=True)
class Row:
    """One metric over the stages; ``group`` is given with the first row of a group."""

    label: str
    arrow: str
    cells: tuple[Cell | None, ...]
    group: str = ""
    size: int = 1


@dataclass(frozen=True)
class Picture:
    """A picture of one stage at one viewpoint; ``url`` is empty where there is none, and ``why`` says the reason."""

    label: str
    url: str
    why: str = ""


@dataclass(frozen=True)
class ChunkPage:
    """One chunk's section. ``headline``: (label, value, comparison); ``views``: (viewpoint, pictures); ``stages``:
    (name, stage, share of the longest in percent, its evaluation)."""

    number: int
    warnings: tuple[str, ...]
    headline: list[tuple[str, str, str]]
    views: list[tuple[str, list[Picture]]]
    rows: list[Row]
    curve: Curve | None
    stages: list[tuple[str, StageSummary, float, StageSummary | None]]
    seconds: float
    evaluation_seconds: float
    from_cache: int
    stage_count: int


def write_report(path: Path, run: RunSummary) -> Path:
    """Writes the report of a run to ``path`` (atomically) and returns it. Raises ``OSError`` where it cannot."""
    from jinja2 import Environment, FileSystemLoader, StrictUndefined

    templates = FileSystemLoader(Path(__file__).parent)
    environment = Environment(loader=templates, autoescape=True, undefined=StrictUndefined, trim_blocks=True)
    environment.lstrip_blocks = True
    template = environment.get_template("report.html.jinja")
    html = template.render(run=run, chunks=[chunk_page(c) for c in run.chunks], columns=[NAMES[s] for s in MEASURED])
    path.parent.mkdir(parents=True, exist_ok=True)
    with atomic_path(path) as part:
        part.write_text(html, encoding="utf-8")
    return path


def chunk_page(chunk: ChunkSummary) -> ChunkPage:
    """What the template shows of one chunk."""
    working = [s for s in chunk.stages if not s.stage.startswith("evaluate/")]
    evaluations = {s.stage.removeprefix("evaluate/"): s for s in chunk.stages if s.stage.startswith("evaluate/")}
    longest = max((s.seconds for s in working), default=0.0) or 1.0
    remarks = [f"{_name(s)}: {w}" for s in chunk.stages for w in s.warnings]
    return ChunkPage(
        number=chunk.chunk,
        warnings=(*chunk.warnings, *remarks),
        headline=headline(chunk),
        views=picture_rows(chunk),
        rows=metric_rows({s.stage: s for s in working if s.stage in MEASURED}),
        curve=accuracy_curve(chunk),
        stages=[(_name(s), s, 100 * s.seconds / longest, evaluations.get(s.stage)) for s in working],
        seconds=sum(s.seconds for s in working),
        evaluation_seconds=sum(s.seconds for s in evaluations.values()),
        from_cache=sum(s.cached for s in chunk.stages),
        stage_count=len(chunk.stages),
    )


def headline(chunk: ChunkSummary) -> list[tuple[str, str, str]]:
    """Label, value and comparison of the few numbers that a reader wants first."""
    initial, gnet, enet = (_metrics(chunk, s) for s in ("initial", "gnet", "enet"))
    fnet = _metrics(chunk, "fnet")
    given = {"shift_3m/psnr": fnet["shift_3m/render_psnr"]} if "shift_3m/render_psnr" in fnet else {}
    wanted = [
        ("Held-out PSNR after GNet", gnet, initial, "interpolation/psnr", "initial"),
        ("Held-out PSNR after ENet", enet, gnet, "interpolation/psnr", "GNet"),
        ("Fixed images at 3 m, PSNR", fnet, given, "shift_3m/psnr", "renders"),
        ("Perceptual at 3 m after ENet", enet, gnet, "shift_3m/perceptual", "GNet"),
        ("Kernel at 3 m after ENet", enet, gnet, "shift_3m/kernel", "GNet"),
    ]
    out = []
    for label, now, before, name, against in wanted:
        value, other = now.get(name), before.get(name)
        if value is not None:
            kind = KINDS[name.rpartition("/")[2]]
            unit = " dB" if name.endswith("psnr") else ""
            change = "" if other is None else f"{_text(value - other, kind, sign=True)} against {against}"
            out.append((label, _text(value, kind) + unit, change))
    return out


def metric_rows(stages: Mapping[str, StageSummary]) -> list[Row]:
    """Rows of the table: groups of held-out frames first, then shifts in order; unknown metrics are left out."""
    known = {name for s in stages.values() for name in s.metrics}
    groups = sorted({n.partition("/")[0] for n in known}, key=_group_order)
    out: list[Row] = []
    for group in groups:
        rows = [
            row
            for prefix in ("", "render_")
            for metric in KINDS
            if f"{group}/{prefix}{metric}" in known
            for row in [_row(stages, group, prefix, metric)]
        ]
        if rows and any(f"{group}/n" in known for _ in rows):
            counts = [s.metrics.get(f"{group}/n") if (s := stages.get(name)) else None for name in MEASURED]
            cells = tuple(None if c is None else Cell(f"{c:.0f}") for c in counts)
            rows.append(Row("images", "", cells))
        if rows:
            first = rows[0]
            rows[0] = Row(first.label, first.arrow, first.cells, _group_label(group), len(rows))
            out += rows
    return out


def _row(stages: Mapping[str, StageSummary], group: str, prefix: str, metric: str) -> Row:
    name, kind = f"{group}/{prefix}{metric}", KINDS[metric]
    found = {s: stages[s] for s in MEASURED if s in stages and name in stages[s].metrics}
    finite = {s: v.metrics[name] for s, v in found.items() if math.isfinite(v.metrics[name])}
    # Values of different numbers of images are not of the same images: only the largest set competes.
    counts = {s: stages[s].metrics.get(f"{group}/n", 0.0) for s in finite}
    rivals = {s: v for s, v in finite.items() if counts[s] == max(counts.values())}
    best = (max if kind.higher else min)(rivals.values()) if len(set(rivals.values())) > 1 else None
    cells: list[Cell | None] = []
    for stage in MEASURED:
        if stage not in found:
            cells.append(None)
            continue
        low_high = found[stage].intervals.get(name)
        interval = "" if low_high is None else f"{_text(low_high[0], kind)} … {_text(low_high[1], kind)}"
        value = found[stage].metrics[name]
        cells.append(Cell(_text(value, kind), interval, best=stage in rivals and value == best))
    label = f"{kind.label} of the renders given" if prefix else kind.label
    return Row(label, "↑" if kind.higher else "↓", tuple(cells))


def picture_rows(chunk: ChunkSummary) -> list[tuple[str, list[Picture]]]:
    """(viewpoint, truth | GNet | fixed | ENet), in the order 0 m, left, right for each camera."""
    stages = {s.stage: s.pictures for s in chunk.stages}
    shown = [stages.get(name, {}) for name, _ in _PICTURES]
    names = sorted({n.removesuffix(_TRUTH) for pictures in shown for n in pictures}, key=_view_order)
    out = []
    for name in names:
        true = next((p[name + _TRUTH] for p in shown if name + _TRUTH in p), None)
        pictures = [Picture("Truth", _url(true), "this log has no true image here")]
        for (_, label), of_stage in zip(_PICTURES, shown, strict=True):
            why = "the fixer works beside the path" if label == "Fixed" and name.startswith("0m_") else "no picture"
            pictures.append(Picture(label, _url(of_stage.get(name)), why))
        out.append((_view_label(name), pictures))
    return out


def _name(stage: StageSummary) -> str:
    return NAMES.get(stage.stage, stage.stage)


def _metrics(chunk: ChunkSummary, name: str) -> Mapping[str, float]:
    stage = chunk.stage(name)
    return {} if stage is None else stage.metrics


def _text(value: float, kind: Kind, sign: bool = False) -> str:
    if not math.isfinite(value):
        return "not finite"
    return f"{value:{'+' if sign else ''}.{kind.decimals}f}".replace("-", "−")


def _group_order(group: str) -> tuple[bool, float, str]:
    shift = group.removeprefix("shift_").removesuffix("m")
    return group != "interpolation", float(shift) if _is_number(shift) else math.inf, group


def _group_label(group: str) -> str:
    shift = group.removeprefix("shift_").removesuffix("m")
    if group == "interpolation":
        return "Held-out frames"
    if not _is_number(shift):
        return group
    return "Held-out frames, as a set" if float(shift) == 0 else f"{shift} m to the side"


def _is_number(text: str) -> bool:
    return text.replace(".", "", 1).isdigit()


def _view_parts(name: str) -> tuple[str, str, str, str]:
    """(shift, side, camera, frame) of a picture's name like ``3m_left_front_camera_04`` or ``0m_front_camera_05``."""
    shift, _, rest = name.partition("_")
    side = next((s for s in ("left", "right") if shift != "0m" and rest.startswith(f"{s}_")), "")
    camera, _, frame = rest.removeprefix(f"{side}_" if side else "").rpartition("_")
    return shift, side, camera, frame


def _view_order(name: str) -> tuple[object, ...]:
    shift, side, camera, frame = _view_parts(name)
    return "front" not in camera, len(camera), camera, shift, side, frame


def _view_label(name: str) -> str:
    shift, side, camera, frame = _view_parts(name)
    where = "On the path" if shift == "0m" else f"{shift.removesuffix('m')} m to the {side}"
    return f"{where} · {camera.replace('_', ' ')} · frame {frame.lstrip('0') or '0'}"


def _url(png: bytes | None) -> str:
    return "" if png is None else "data:image/png;base64," + base64.b64encode(png).decode()
