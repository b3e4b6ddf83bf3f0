"""What FNet brings beside the path and what it costs, as the preset ``small`` uses it.

genre bench fixer --json docs/benchmarks/fixer.json [--set seeds=1001] [--set pandaset=]

A log makes a cell. Views at 3 m are those that the optimiser's benchmark judges by: spread over sides, frames and
cameras, none of them seen by any stage. Fixers of fewer inputs are measured too where ``--set ablations=FOLDER`` has
them, each trained as long as the others by ``genre train fnet --inputs …``.
"""

from __future__ import annotations

import statistics
from collections.abc import Iterator, Mapping, Sequence
from functools import partial

import numpy as np

from benchmarks.common.bench import Bench, Cell, Row, logs_of
from benchmarks.common.claims import Claim, claim
from benchmarks.common.context import place
from benchmarks.common.timing import Measured
from benchmarks.fixer.cells import ABLATIONS, EVERYTHING, GATE_SHIFTS_M, KERNEL_SHIFTS_M, ablated, measure_fixer
from flows.configuration import load_configuration
from flows.pipeline.definition import BY_NAME, stage_weights, weights_digest
from genre_tasks.metrics.scoring import BOOTSTRAP_SEED

FEWER = {"render": "src", "render+reference": "src_ref", "reference+lidar": "ref_lidar"}
"""Inputs that all three are held against, and what the paper's Table 3 calls them."""

CELL_S = 200.0
"""Predicted: the steps before FNet, twelve ray-cast views, a few hundred fixed ones."""
RESAMPLES = 2000


class Fixer:
    """A cell for each log."""

    name = "fixer"
    options: Mapping[str, str] = {
        "seeds": "1001,1002,1003,1004,1005",
        "store": "genre-store",
        "pandaset": "../shared/data/pandaset/002",
        "ablations": "training",
    }
    code: tuple[str, ...] = (
        "benchmarks.fixer.cells",
        "genre_tasks.stages.optimise",
        "genre_tasks.stages.novel_views",
        "genre_tasks.stages.fnet",
        "genre_tasks.stages.ingest",
        "genre_tasks.stages.initial",
        "genre_tasks.logs.pandaset.reader",
        "genre_tasks.logs.synthetic",
    )

    def cells(self, options: Mapping[str, str], quick: bool) -> list[Cell]:
        """``quick``: one street. An empty ``pandaset`` leaves the real log out."""
        logs = logs_of(options)
        small = load_configuration("small")
        digests = [stage_weights(BY_NAME[name], small) for name in ("gnet", "fnet")]
        fewer = {inputs: weights_digest(path) for inputs, path in ablated(options["ablations"]).items()}
        parameters = {"configuration": small.model_dump(mode="json"), "weights": digests, "ablations": fewer}
        told = (options["store"], options["ablations"])
        return [
            Cell(f"{log} chunk {chunk}", CELL_S, partial(measure_fixer, log, chunk, *told), parameters)
            for log, chunk in (logs[:1] if quick else logs)
        ]

    def claims(self, rows: Mapping[str, Row]) -> Iterator[Claim]:
        """Over the views of all synthetic logs; on the real one at each shift; flicker and time over all logs."""
        found = measured(rows)
        streets, reals = [r for r in found if "truth" in r], [r for r in found if "kernel" in r]
        views = f"{len(of_views(streets, 'render', 'psnr'))} views at 3 m; {_of(streets)}"
        gains, part = differences(streets, "psnr"), reduced(streets)
        note = "mean over views, 95 % interval by bootstrap over views"
        data = f"PSNR of the fixed less that of the render, {note}; {views}"
        yield claim("fixer.psnr_3m", mean(gains), ">=", 1.0, "dB", data, len(gains), interval(gains))
        data = f"perceptual distance, the part of the render's that fixing takes away, {note}; {views}"
        yield claim("fixer.perceptual_3m", mean(part), ">=", 0.25, "part", data, len(part), interval(part))
        yield from _loose([r for r in streets if "loose" in r], note)
        clean = of_views(streets, "clean", "psnr")
        data = f"the truth given as the render: PSNR of what comes back, the worst view; {views}"
        yield claim("fixer.identity", min(clean, default=None), ">=", 35.0, "dB", data, len(clean))
        for other, name in FEWER.items():
            yield from _against(streets, other, name)
        for shift in KERNEL_SHIFTS_M:
            yield _kernel(reals, f"{shift:g}")
        ratios = [r["flicker"]["fixed"] / r["flicker"]["render"] for r in found]
        note = "difference between consecutive frames, the next warped by rendered depth: fixed over render"
        true = [r["flicker"]["truth"] / r["flicker"]["render"] for r in found if "truth" in r["flicker"]]
        said = f" (of true images: {min(true):.2f} to {max(true):.2f})" if true else ""
        data = f"{note}, the worst log{said}; {_of(found)}"
        yield claim("fixer.flicker", max(ratios, default=None), "<=", 1.0, "ratio", data, len(ratios))
        lost = [b / a - 1 for row in streets for g in row["gate"] for a, b in zip(g["render"], g["fixed"], strict=True)]
        data = (
            f"perceptual distance of a fixed view over its render's, less 1: the worst at 0.25 to 3 m; {_of(streets)}"
        )
        yield claim("fixer.no_view_worse", max(lost, default=None), "<=", 0.02, "part", data, len(lost))
        yield _seconds(found)

    def table(self, rows: Mapping[str, Row]) -> Iterator[str]:
        """A line for each log."""
        yield "| log | PSNR at 3 m: render | fixed | perceptual: render | fixed | clean | flicker | true | s a view |"
        yield "|---|---|---|---|---|---|---|---|---|"
        for row in measured(rows):
            pairs = [(kind, key) for key in ("psnr", "perceptual") for kind in ("render", "fixed")]
            values = [f"{_mean(row, *p):.3f}" if "truth" in row else "" for p in pairs]
            values.append(f"{_mean(row, 'clean', 'psnr'):.2f}" if "truth" in row else "")
            ratio = row["flicker"]["fixed"] / row["flicker"]["render"]
            true = f"{row['flicker']['truth'] / row['flicker']['render']:.3f}" if "truth" in row["flicker"] else ""
            yield f"| {place(row)} | {' | '.join(values)} | {ratio:.3f} | {true} | {seconds_a_view(row):.3f} |"
        yield ""
        yield "| log | ground | PSNR at 3 m: render | fixed | perceptual: render | fixed |"
        yield "|---|---|---|---|---|---|"
        for row in (r for r in measured(rows) if "loose" in r):
            for of, ground in (("truth", "held"), ("loose", "not held")):
                pairs = [(kind, key) for key in ("psnr", "perceptual") for kind in ("render", "fixed")]
                yield f"| {place(row)} | {ground} | {' | '.join(f'{_mean(row, *p, of):.3f}' for p in pairs)} |"
        yield ""
        yield "| inputs, trained as long | PSNR at 3 m | perceptual | s a view |"
        yield "|---|---|---|---|"
        for inputs in ABLATIONS:
            found = [row["inputs"][inputs] for row in measured(rows) if inputs in row.get("inputs", {})]
            if found:
                means = [statistics.fmean(x for row in found for x in row[key]) for key in ("psnr", "perceptual")]
                spent = statistics.median(row["seconds"] for row in found)
                yield f"| {inputs} | {means[0]:.3f} | {means[1]:.3f} | {spent:.3f} |"
        yield ""
        yield "| shift, m | views | calls for fixing: least | median | most | perceptual: render | fixed | worst view |"
        yield "|---|---|---|---|---|---|---|---|"
        for shift in GATE_SHIFTS_M:
            at = [g for row in measured(rows) for g in row.get("gate", []) if g["shift"] == shift]
            if at:
                calls, before, after = ([x for g in at for x in g[key]] for key in ("need", "render", "fixed"))
                worst = max(b / a - 1 for a, b in zip(before, after, strict=True))
                middle = [f"{f(calls):.3f}" for f in (min, statistics.median, max)]
                middle += [f"{statistics.fmean(x):.3f}" for x in (before, after)]
                yield f"| {shift:g} | {len(calls)} | {' | '.join(middle)} | {worst:+.1%} |"
        yield ""
        yield "| log | shift, m | kernel distance: render | fixed | difference, 95 % interval |"
        yield "|---|---|---|---|---|"
        for row in (r for r in measured(rows) if "kernel" in r):
            for shift, k in row["kernel"].items():
                spread = f"{k['difference']:+.4f} ({k['low']:+.4f} … {k['high']:+.4f})"
                yield f"| {place(row)} | {shift} | {k['render']:.4f} | {k['render'] + k['difference']:.4f} | {spread} |"
        for name in (n for n, r in rows.items() if "not_measured" in r):
            yield f"\n{name}: not measured: {rows[name]['not_measured']}"


def measured(rows: Mapping[str, Row]) -> list[Row]:
    """Those that were."""
    return [row for row in rows.values() if "not_measured" not in row]


def of_views(streets: Sequence[Row], kind: str, key: str, of: str = "truth") -> list[float]:
    """One number for each view of all logs; ``of``: "loose" for renders of scenes whose ground is not held."""
    return [x for row in streets for x in row[of][kind][key]]


def differences(streets: Sequence[Row], key: str, of: str = "truth") -> list[float]:
    """The fixed view's number less the render's."""
    pairs = zip(of_views(streets, "fixed", key, of), of_views(streets, "render", key, of), strict=True)
    return [after - before for after, before in pairs]


def reduced(streets: Sequence[Row], of: str = "truth") -> list[float]:
    """For each view, by how much fixing lessens the perceptual distance, in parts of the renders' mean."""
    base = of_views(streets, "render", "perceptual", of)
    return [-d / statistics.fmean(base) for d in differences(streets, "perceptual", of)]


def mean(values: Sequence[float]) -> float | None:
    """The mean, or ``None`` where nothing was measured."""
    return statistics.fmean(values) if values else None


def interval(values: Sequence[float]) -> tuple[float, float] | None:
    """95 % of the means of resampled views; ``None`` without any."""
    if not values:
        return None
    drawn = np.random.default_rng(BOOTSTRAP_SEED).choice(values, (RESAMPLES, len(values)))
    low, high = np.quantile(drawn.mean(1), [0.025, 0.975])
    return float(low), float(high)


def seconds_a_view(row: Row) -> float:
    """The median run's."""
    return float(statistics.median(row["time"]["seconds"]) / row["time"]["views"])


def lessened(streets: Sequence[Row], other: str) -> list[float]:
    """For each view, how much lower all inputs bring the perceptual distance than ``other`` do, in parts of its mean.

    Empty where a log lacks one of the two.
    """
    if not all({other, EVERYTHING} <= set(row["inputs"]) for row in streets):
        return []
    fewer, every = ([x for row in streets for x in row["inputs"][i]["perceptual"]] for i in (other, EVERYTHING))
    return [(a - b) / statistics.fmean(fewer) for a, b in zip(fewer, every, strict=True)]


def _against(streets: Sequence[Row], other: str, name: str) -> Iterator[Claim]:
    """All inputs against fewer, trained as long: the paired interval excludes 0; for src + ref the mean is 5 % too."""
    part = lessened(streets, other)
    bounds = interval(part)
    said = f"mean {statistics.fmean(part):+.1%}" if part else "not measured"
    note = f"perceptual distance with all inputs against {other}, trained as long: part that it is lower, {said}"
    if name == "src_ref":
        data = f"{note}; interval by paired bootstrap over views; {_of(streets)}"
        yield claim("fixer.vs_src_ref", mean(part), ">=", 0.05, "part", data, len(part), bounds)
        name = "src_ref_low"
    data = f"lower end of the 95 % interval (paired bootstrap over views): {note}; {_of(streets)}"
    yield claim(f"fixer.vs_{name}", None if bounds is None else bounds[0], ">", 0.0, "part", data, len(part), bounds)


def _loose(streets: Sequence[Row], note: str) -> Iterator[Claim]:
    """The first two claims where the optimiser does not hold the ground (``gnet.constrain_ground=false``)."""
    gains, part = differences(streets, "psnr", "loose"), reduced(streets, "loose")
    said = f"of scenes whose ground is not held, {note}; {len(gains)} views at 3 m; {_of(streets)}"
    data = f"PSNR of the fixed less that of the render, {said}"
    yield claim("fixer.psnr_3m_loose", mean(gains), ">=", 1.0, "dB", data, len(gains), interval(gains))
    data = f"perceptual distance, the part of the render's that fixing takes away, {said}"
    yield claim("fixer.perceptual_3m_loose", mean(part), ">=", 0.25, "part", data, len(part), interval(part))


def _kernel(reals: Sequence[Row], shift: str) -> Claim:
    at = [row["kernel"][shift] for row in reals]
    high = max((k["high"] for k in at), default=None)
    said = "; ".join(f"{k['difference'] / k['render']:+.1%} of {k['render']:.4f}" for k in at) or "not measured"
    note = f"upper end of the 95 % interval of the kernel distance's difference at {shift} m: {said}; {_of(reals)}"
    return claim(f"fixer.real_kernel_{shift}m", high, "<", 0.0, "distance", note, len(at))


def _seconds(found: Sequence[Row]) -> Claim:
    spent = [seconds_a_view(row) for row in found]
    if not spent:
        return claim("fixer.seconds_per_frame", None, "<=", 0.6, "s", "not measured")
    m, run = Measured.of(spent), found[0]["time"]
    data = f"{run['size'][1]}×{run['size'][0]}, batches of {run['batch']}, two threads; median over logs; {_of(found)}"
    return claim("fixer.seconds_per_frame", m.median, "<=", 0.6, "s", data, m.n, m.spread)


def _of(rows: Sequence[Row]) -> str:
    return ", ".join(map(place, rows)) or "not measured"


def _mean(row: Row, kind: str, key: str, of: str = "truth") -> float:
    return statistics.fmean(row[of][kind][key])


BENCH: Bench = Fixer()
