"""A sweep's table as what a budget chooses from."""

from __future__ import annotations

import json
import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path

from flows.cost_sweep.knobs import EFFECTS
from flows.cost_sweep.parquet import read_lines
from flows.cost_sweep.summary import MEASURES, PSNR, Line
from genre_tasks.errors import ConfigError

SHIPPED = Path(__file__).resolve().parents[2] / "configs"


@dataclass(frozen=True)
class Point:
    """A setting: ``changes`` over the preset up to the stage ``end``; its accuracy (more is better), warm seconds."""

    name: str
    changes: tuple[str, ...]
    end: str
    accuracy: float
    seconds: Mapping[str, float]


@dataclass(frozen=True)
class Table:
    """Points of one preset, and how fast the machine was that they were measured on.

    ``judged`` says what accuracy is; ``images`` of a chunk were reconstructed; ``calibration_s`` and ``cold`` seconds
    of first calls by stage, see ``flows.machine.calibration`` and ``flows.cost_sweep.warm_up``.
    """

    preset: str
    judged: str
    points: tuple[Point, ...]
    images: float
    calibration_s: float
    cold: Mapping[str, float]
    machine: str


def shipped_table(preset: str) -> Path:
    """The table that comes with the preset. Raises ``ConfigError`` for a preset that has none."""
    path = SHIPPED / f"cost_{preset}.parquet"
    if not path.is_file():
        known = ", ".join(p.stem.removeprefix("cost_") for p in sorted(SHIPPED.glob("cost_*.parquet"))) or "none"
        raise ConfigError(
            f"no times were measured for the preset {preset}",
            remedy=f"Measure them with `genre cost LOG --preset {preset}` and give its cost.parquet with --table. "
            f"Measured: {known}.",
        )
    return path


def load(path: Path, preset: str, own: Iterable[str] = ()) -> Table:
    """The table of a sweep over ``preset``, for a run whose user has set the keys ``own``.

    Effects, threads and the images' size are left out: a log's plan decides the first, the machine has the second, and
    the third is what the user asked for; so are settings that were not measured wherever the preset was. Raises
    ``ConfigError`` for a table of another preset, one made by a sweep that did not say how fast its machine was, or one
    that turns what the user has set.
    """
    remedy = f"Give the cost.parquet of `genre cost LOG --preset {preset}`."
    if not path.is_file():
        raise ConfigError("there is no table", remedy=remedy, file=path)
    lines, facts = read_lines(path)
    if facts.get("base") != preset:
        raise ConfigError(f"this table is of the preset {facts.get('base')}", remedy=remedy, file=path)
    if "calibration_s" not in facts:
        raise ConfigError("this table does not say how fast its machine was", remedy=remedy, file=path)
    judged = next((m for m in MEASURES if m.name == facts["judged"]), PSNR)
    sign = 1.0 if judged.more_is_better else -1.0
    points = tuple(
        Point(x.setting, x.changes, x.end, sign * x.values[judged.name].middle, x.stage_seconds)
        for x in lines
        if _is_a_choice(x) and x.n == lines[0].n and math.isfinite(x.values[judged.name].middle)
    )
    turned = {change.partition("=")[0] for p in points for change in p.changes}
    if both := sorted(turned & set(own)):
        raise ConfigError(
            f"{', '.join(both)} is what a budget decides", remedy="Leave out either --budget or that setting."
        )
    return Table(
        preset,
        judged.label,
        points,
        _images(lines),
        float(facts["calibration_s"]),
        json.loads(facts["cold_seconds"]),
        facts["machine"],
    )


def _is_a_choice(line: Line) -> bool:
    return line.knob != EFFECTS and not line.threads and not any(c.startswith("ingest.") for c in line.changes)


def _images(lines: list[Line]) -> float:
    return lines[0].source_images
