"""What a sweep's rows say: averages, spreads, what each setting gains over the preset, and which none beats."""

from __future__ import annotations

import math
import statistics
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

from flows.cost_sweep.knobs import PRESET_ITSELF
from flows.experiments.log_chunks import LogChunk

Row = Mapping[str, Any]


@dataclass(frozen=True)
class Measure:
    """A quantity of a sweep's rows.

    Attributes:
        name: as in the names of table columns.
        label: for readers, with the unit.
        read: reads the quantity off a row; NaN where the row has none.
        more_is_better: whether a larger number is better.
        average: how seeds are averaged: the median for costs, which a busy machine disturbs.
    """

    name: str
    label: str
    read: Callable[[Row], float]
    more_is_better: bool
    average: Literal["mean", "median"] = "mean"


def _read_metric(name: str) -> Callable[[Row], float]:
    return lambda row: float(row["metrics"].get(name, math.nan))


def total_seconds(row: Row) -> float:
    """Adds up the seconds of a row's stages; evaluation is not among them.

    >>> total_seconds({"seconds": {"ingest": 1.0, "gnet": 2.5}})
    3.5
    """
    return float(sum(row["seconds"].values()))


def _total_cpu_seconds(row: Row) -> float:
    # A sum without the stage that was not counted would look like a gain.
    return math.nan if None in row["cpu_seconds"].values() else float(sum(row["cpu_seconds"].values()))


PSNR = Measure("psnr", "PSNR held out, dB", _read_metric("interpolation/psnr"), True)
PERCEPTUAL_3M = Measure("perceptual_3m", "perceptual distance at 3 m", _read_metric("shift_3m/perceptual"), False)
KERNEL_3M = Measure("kernel_3m", "kernel distance at 3 m", _read_metric("shift_3m/kernel"), False)
MEASURES: tuple[Measure, ...] = (
    PSNR,
    Measure("ssim", "SSIM held out", _read_metric("interpolation/ssim"), True),
    Measure("perceptual", "perceptual distance held out", _read_metric("interpolation/perceptual"), False),
    Measure("psnr_3m", "PSNR at 3 m, dB", _read_metric("shift_3m/psnr"), True),
    PERCEPTUAL_3M,
    KERNEL_3M,
    Measure("frechet_3m", "Fréchet distance at 3 m", _read_metric("shift_3m/frechet"), False),
)
COSTS: tuple[Measure, ...] = (
    Measure("seconds", "seconds", total_seconds, False, "median"),
    Measure("cpu_seconds", "CPU seconds", _total_cpu_seconds, False, "median"),
    Measure("peak_mib", "peak memory, MiB", lambda row: float(row["peak_mib"]), False, "median"),
    Measure("gaussians", "Gaussians", lambda row: float(row["gaussians"]), False, "median"),
)


@dataclass(frozen=True)
class Spread:
    """What a setting's rows have in one measure.

    Attributes:
        average: over the seeds of each chunk, then over chunks.
        sd: standard deviation over seeds, pooled over chunks; NaN with one seed.
    """

    average: float
    sd: float


@dataclass(frozen=True)
class SettingSummary:
    """A setting over all of its cells.

    Attributes:
        knob: what is turned.
        value: to what it is turned.
        setting: ``knob=value``.
        n: number of cells.
        values: by measure.
        gains: by measure, over the preset on the same chunk with the same seed, in the measure's unit; positive where
            the setting is better.
        stage_seconds: median wall seconds by stage.
        images_at_3m: number of images that distances at 3 m are of.
        changes: ``section.key=value`` over the preset.
        end: the stage whose scene is the result.
        threads: threads of the CPU; 0 for all.
        source_images: number of images of a chunk.
        on_front: the measures in which no setting is as good in less time. A setting with fewer cells than the preset
            is of other chunks, and on no front.
    """

    knob: str
    value: str
    setting: str
    n: int
    values: Mapping[str, Spread]
    gains: Mapping[str, Spread]
    stage_seconds: Mapping[str, float]
    images_at_3m: float
    changes: tuple[str, ...]
    end: str
    threads: int
    source_images: float
    on_front: tuple[str, ...] = ()

    @property
    def seconds(self) -> float:
        """Median seconds of the stages up to the end."""
        return self.values["seconds"].average


def novel_view_measure(rows: Sequence[Row]) -> Measure:
    """Chooses what settings are compared by away from the recorded path.

    Args:
        rows: all rows of a sweep.

    Returns:
        The perceptual distance to the true images at 3 m where every row has it, else the kernel distance.
    """
    # One measure for all rows: settings that are compared by different ones could not be ordered.
    has_truth = rows and all(math.isfinite(PERCEPTUAL_3M.read(r)) for r in rows)
    return PERCEPTUAL_3M if has_truth else KERNEL_3M


def summarise_settings(rows: Sequence[Row]) -> list[SettingSummary]:
    """Summarises each setting.

    Args:
        rows: see :func:`flows.cost_sweep.cell.run_cell`; without rows of the preset itself, no setting has gains and
            none is on a front.

    Returns:
        A summary for each setting, in the order of the rows.
    """
    by_setting: dict[str, list[Row]] = {}
    for row in rows:
        by_setting.setdefault(row["setting"], []).append(row)
    preset_rows = by_setting.get(PRESET_ITSELF, [])
    reference = {(_chunk_of(r), r["seed"]): r for r in preset_rows}
    # Gains are paired by chunk and seed, because chunks differ more from each other than settings do.
    summaries = [_summarise(part, reference) for part in by_setting.values()]
    fronts = {
        measure.name: pareto_front(
            [(x.seconds, _average_if_complete(x, measure, len(preset_rows))) for x in summaries],
            measure.more_is_better,
        )
        for measure in (PSNR, novel_view_measure(rows))
    }
    return [
        replace(x, on_front=tuple(name for name, front in fronts.items() if k in front))
        for k, x in enumerate(summaries)
    ]


def _average_if_complete(summary: SettingSummary, measure: Measure, cells: int) -> float:
    # A failed chunk may be the hardest one, so an incomplete setting must not win by leaving it out.
    return summary.values[measure.name].average if summary.n == cells else math.nan


def pareto_front(points: Sequence[tuple[float, float]], more_is_better: bool) -> set[int]:
    """Finds the points that no other point beats: as good in less time, or better in no more time.

    Args:
        points: (seconds, accuracy) of each; a point whose accuracy is NaN is on no front and beats none.
        more_is_better: whether a larger accuracy is better.

    Returns:
        Indices into ``points``.

    >>> sorted(pareto_front([(1.0, 20.0), (2.0, 25.0), (3.0, 24.0)], more_is_better=True))
    [0, 1]
    """
    sign = 1.0 if more_is_better else -1.0
    front = set()
    for k, (seconds, value) in enumerate(points):
        others = [(s, v) for j, (s, v) in enumerate(points) if j != k and math.isfinite(v)]
        # Strict in one of the two: points that are equal in both must not remove each other.
        beaten = any(
            s <= seconds and sign * v >= sign * value and (s < seconds or sign * v > sign * value) for s, v in others
        )
        if math.isfinite(value) and not beaten:
            front.add(k)
    return front


def _summarise(rows: Sequence[Row], reference: Mapping[tuple[LogChunk, int], Row]) -> SettingSummary:
    pairs = [(r, reference[_chunk_of(r), r["seed"]]) for r in rows if (_chunk_of(r), r["seed"]) in reference]
    measures = (*COSTS, *MEASURES)
    first = rows[0]
    return SettingSummary(
        knob=first["knob"],
        value=first["value"],
        setting=first["setting"],
        n=len(rows),
        values={m.name: _spread([(_chunk_of(r), m.read(r)) for r in rows], m) for m in measures},
        gains={m.name: _spread([(_chunk_of(r), _gain(m, r, base)) for r, base in pairs], m) for m in measures},
        # The median, because a single disturbed run would shift a mean of three.
        stage_seconds={s: statistics.median(r["seconds"][s] for r in rows) for s in first["seconds"]},
        images_at_3m=statistics.mean(float(r["metrics"].get("shift_3m/n", 0)) for r in rows),
        changes=tuple(first["changes"]),
        end=first["end"],
        threads=first["threads"],
        source_images=statistics.mean(float(r["images"]) for r in rows),
    )


def _gain(measure: Measure, row: Row, reference: Row) -> float:
    # The sign makes positive mean better in every measure, so that a reader need not know each one's direction.
    return (measure.read(row) - measure.read(reference)) * (1 if measure.more_is_better else -1)


def _chunk_of(row: Row) -> LogChunk:
    return LogChunk(row["log"], row["chunk"])


def _spread(values: Sequence[tuple[LogChunk, float]], measure: Measure) -> Spread:
    """Averages the seeds of each chunk, then the chunks, which may have different numbers of seeds."""
    # A mean of the remaining values would be of other chunks than the preset's.
    if not values or not all(math.isfinite(v) for _, v in values):
        return Spread(math.nan, math.nan)
    by_chunk: dict[LogChunk, list[float]] = {}
    for chunk, value in values:
        by_chunk.setdefault(chunk, []).append(value)
    # Pooled, because three seeds of a single chunk give no stable deviation.
    freedom = sum(len(v) - 1 for v in by_chunk.values())
    within = sum(sum((x - statistics.mean(v)) ** 2 for x in v) for v in by_chunk.values())
    # Deviations are from each chunk's own mean: how much easier one log is than another is no spread over seeds.
    sd = math.sqrt(within / freedom) if freedom else math.nan
    average = statistics.median if measure.average == "median" else statistics.mean
    return Spread(statistics.mean(average(v) for v in by_chunk.values()), sd)
