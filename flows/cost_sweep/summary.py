"""What a sweep's rows say: middles, spreads, what each setting gains over the preset, and which none beats."""

from __future__ import annotations

import math
import statistics
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

from flows.cost_sweep.knobs import PRESET_ITSELF

Row = Mapping[str, Any]


@dataclass(frozen=True)
class Measure:
    """A column: its name, how it is read off a row (NaN: the row has none), and whether more is better.

    ``middle`` of the seeds: of what a busy machine disturbs (costs) the median.
    """

    name: str
    label: str
    read: Callable[[Row], float]
    more_is_better: bool
    middle: Literal["mean", "median"] = "mean"


def _metric(name: str) -> Callable[[Row], float]:
    return lambda row: float(row["metrics"].get(name, math.nan))


def total_seconds(row: Row) -> float:
    """Of all stages of the row, evaluation not among them."""
    return float(sum(row["seconds"].values()))


def _cpu_seconds(row: Row) -> float:
    return math.nan if None in row["cpu_seconds"].values() else float(sum(row["cpu_seconds"].values()))


PSNR = Measure("psnr", "PSNR held out, dB", _metric("interpolation/psnr"), True)
PERCEPTUAL_3M = Measure("perceptual_3m", "perceptual distance at 3 m", _metric("shift_3m/perceptual"), False)
KERNEL_3M = Measure("kernel_3m", "kernel distance at 3 m", _metric("shift_3m/kernel"), False)
MEASURES: tuple[Measure, ...] = (
    PSNR,
    Measure("ssim", "SSIM held out", _metric("interpolation/ssim"), True),
    Measure("perceptual", "perceptual distance held out", _metric("interpolation/perceptual"), False),
    Measure("psnr_3m", "PSNR at 3 m, dB", _metric("shift_3m/psnr"), True),
    PERCEPTUAL_3M,
    KERNEL_3M,
    Measure("frechet_3m", "Fréchet distance at 3 m", _metric("shift_3m/frechet"), False),
)
COSTS: tuple[Measure, ...] = (
    Measure("seconds", "seconds", total_seconds, False, "median"),
    Measure("cpu_seconds", "CPU seconds", _cpu_seconds, False, "median"),
    Measure("peak_mib", "peak memory, MiB", lambda row: float(row["peak_mib"]), False, "median"),
    Measure("gaussians", "Gaussians", lambda row: float(row["gaussians"]), False, "median"),
)


@dataclass(frozen=True)
class Spread:
    """The middle, and the standard deviation over seeds (pooled over places; NaN with one seed)."""

    middle: float
    sd: float


@dataclass(frozen=True)
class Line:
    """A setting: ``n`` cells; ``values`` by measure; ``gains`` over the preset in the same place with the same seed.

    A gain is in the measure's unit, positive where the setting is better. ``images`` are those at 3 m that distances
    are of, ``source_images`` those of a chunk. ``on_front`` names the measures in which no setting is as good in less
    time; a setting with fewer cells than the preset is of other places, and left out.
    """

    knob: str
    value: str
    setting: str
    n: int
    values: Mapping[str, Spread]
    gains: Mapping[str, Spread]
    stage_seconds: Mapping[str, float]
    images: float
    changes: tuple[str, ...]
    end: str
    threads: int
    source_images: float
    on_front: tuple[str, ...] = ()

    @property
    def seconds(self) -> float:
        return self.values["seconds"].middle


def beside(rows: Sequence[Row]) -> Measure:
    """What a sweep is judged by beside the path: against the truth where there is one, else the kernel distance."""
    true = rows and all(math.isfinite(PERCEPTUAL_3M.read(r)) for r in rows)
    return PERCEPTUAL_3M if true else KERNEL_3M


def lines_of(rows: Sequence[Row]) -> list[Line]:
    """A line for each setting, in the order of the rows. Rows of the preset itself have to be among them."""
    by: dict[str, list[Row]] = {}
    for row in rows:
        by.setdefault(row["setting"], []).append(row)
    own = {(*_place(r), r["seed"]): r for r in by.get(PRESET_ITSELF, ())}
    lines = [_line(name, part, own) for name, part in by.items()]
    chosen, whole = (PSNR, beside(rows)), len(by.get(PRESET_ITSELF, ()))
    fronts = {
        m.name: front(
            [(x.seconds, x.values[m.name].middle if x.n == whole else math.nan) for x in lines], m.more_is_better
        )
        for m in chosen
    }
    return [
        Line(**{**vars(x), "on_front": tuple(m for m, found in fronts.items() if k in found)})
        for k, x in enumerate(lines)
    ]


def front(points: Sequence[tuple[float, float]], more_is_better: bool) -> set[int]:
    """Indices of the points (seconds, accuracy) that no other one beats: as good in less time, or better in no more."""
    sign = 1.0 if more_is_better else -1.0
    out = set()
    for k, (seconds, value) in enumerate(points):
        others = [(s, v) for j, (s, v) in enumerate(points) if j != k and math.isfinite(v)]
        beaten = any(
            s <= seconds and sign * v >= sign * value and (s < seconds or sign * v > sign * value) for s, v in others
        )
        if math.isfinite(value) and not beaten:
            out.add(k)
    return out


def _line(name: str, rows: Sequence[Row], own: Mapping[tuple[Any, ...], Row]) -> Line:
    pairs = [(r, own[(*_place(r), r["seed"])]) for r in rows if (*_place(r), r["seed"]) in own]
    values = {m.name: _spread([(_place(r), m.read(r)) for r in rows], m) for m in (*COSTS, *MEASURES)}
    gains = {
        m.name: _spread([(_place(r), (m.read(r) - m.read(o)) * (1 if m.more_is_better else -1)) for r, o in pairs], m)
        for m in (*COSTS, *MEASURES)
    }
    stages = {s: statistics.median(r["seconds"][s] for r in rows) for s in rows[0]["seconds"]}
    images = statistics.mean(float(r["metrics"].get("shift_3m/n", 0)) for r in rows)
    source = statistics.mean(float(r["images"]) for r in rows)
    first = rows[0]
    own_setting = tuple(first["changes"]), first["end"], first["threads"]
    return Line(first["knob"], first["value"], name, len(rows), values, gains, stages, images, *own_setting, source)


def _place(row: Row) -> tuple[Any, ...]:
    return row["log"], row["chunk"]


def _spread(values: Sequence[tuple[tuple[Any, ...], float]], measure: Measure) -> Spread:
    """The middle of each place's seeds, averaged over places, which may have different numbers of them."""
    if not values or not all(math.isfinite(v) for _, v in values):
        return Spread(math.nan, math.nan)
    by: dict[tuple[Any, ...], list[float]] = {}
    for place, value in values:
        by.setdefault(place, []).append(value)
    freedom = sum(len(v) - 1 for v in by.values())
    within = sum(sum((x - statistics.mean(v)) ** 2 for x in v) for v in by.values())
    sd = math.sqrt(within / freedom) if freedom else math.nan
    middle = statistics.median if measure.middle == "median" else statistics.mean
    return Spread(statistics.mean(middle(v) for v in by.values()), sd)
