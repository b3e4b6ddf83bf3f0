"""Logs as they are: what multi-view stereo, refined poses and exposure gain on real logs, and on streets that err.

genre bench real_logs --json docs/results/data/real_logs.json [--set seeds=1001,1002] [--set kitti=] [--set pandaset=]
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from functools import partial
from statistics import mean

from benchmarks.common.bench import (
    TINY_SETTINGS,
    TINY_STREET,
    Bench,
    Cell,
    Row,
    SmallestForm,
    list_not_measured,
    measured_rows,
    settings_from_options,
    split_option,
)
from benchmarks.common.claims import Claim, claim
from benchmarks.common.lazy_modules import STAGE_MODULES
from benchmarks.real_logs.measures import NOISE, LogOfBench, measure_chain, measure_effects, measure_pose_noise
from benchmarks.real_logs.optimiser_race import METHODS, describe_race, format_races, make_race_claims, measure_race

_KITTI_SETTINGS = ("ingest.width_px=480", "ingest.height_px=145")
_CHAIN_S = 150.0
_EFFECTS_S = 120.0
_NOISE_S = 120.0
_RACE_S = 180.0

BASE_PSNR_DB = 19.7
"""Held-out PSNR of the KITTI slice before exposure, stereo and poses were looked at."""


class RealLogsBench:
    """The KITTI slice through the whole chain, the new effects on each log, and streets whose poses err."""

    name = "real_logs"
    options: Mapping[str, str] = {
        "seeds": "1001,1002,1003",
        "kitti": "../shared/data/kitti/2011_09_26/2011_09_26_drive_0009_sync"
        "?labels=../shared/data/kitti/tracking_labels/0001_first20.txt",
        "pandaset": "../shared/data/pandaset/002",
        "preset": "small",
        "orders": "0,1,2",
        "settings": "",
        "store": "genre-store",
    }
    code: tuple[str, ...] = (
        "benchmarks.real_logs.measures",
        "benchmarks.real_logs.optimiser_race",
        "genre_tasks.logs.kitti.reader",
        "genre_tasks.logs.pandaset.reader",
        "genre_tasks.logs.synthetic",
        # It scores the scenes of races.
        "flows.training.optimiser_training",
        *STAGE_MODULES,
    )
    smallest = SmallestForm(
        {"seeds": TINY_STREET, "kitti": "", "pandaset": "", "preset": "demo", "settings": TINY_SETTINGS}, "effects"
    )

    def cells(self, options: Mapping[str, str], quick: bool) -> list[Cell]:
        """Lists the chain on KITTI, the effects of each log, and the noisy streets; ``quick`` takes one street."""
        settings = settings_from_options(options)
        seeds = split_option(options["seeds"])[: 1 if quick else None]
        streets = [self._log(options, f"synthetic:street?seed={seed}", 0, settings) for seed in seeds]
        logs = []
        cells = []
        if options["kitti"]:
            kitti = self._log(options, f"kitti:{options['kitti']}", 0, (*_KITTI_SETTINGS, *settings))
            cells.append(Cell("chain kitti", _CHAIN_S, partial(measure_chain, kitti), kitti.parameters))
            logs.append(kitti)
        if options["pandaset"]:
            logs += [self._log(options, f"pandaset:{options['pandaset']}", chunk, settings) for chunk in (0, 1)]
        # Orders are outermost: a run that is stopped early has every log once. Chunk 0 was trained on.
        for order in map(int, split_option(options["orders"])[: 1 if quick else None]):
            for method in METHODS[: 1 if quick else None]:
                for log in (log for log in logs if (log.chunk, log.uri.partition(":")[0]) != (0, "pandaset")):
                    name = f"race {log.name} order {order} {method}"
                    measure = partial(measure_race, log, order, method)
                    cells.append(Cell(name, _RACE_S, measure, describe_race(log, order, method)))
        for log in (*logs, *streets):
            cells.append(Cell(f"effects {log.name}", _EFFECTS_S, partial(measure_effects, log), log.parameters))
        for log in streets:
            parameters = {**log.parameters, "noise": NOISE}
            cells.append(Cell(f"pose noise {log.name}", _NOISE_S, partial(measure_pose_noise, log), parameters))
        return cells

    def _log(self, options: Mapping[str, str], uri: str, chunk: int, settings: tuple[str, ...]) -> LogOfBench:
        return LogOfBench(uri, chunk, options["preset"], settings, options["store"])

    def claims(self, rows: Mapping[str, Row]) -> Iterator[Claim]:
        """Claims on the KITTI slice, on what the effects gain, and on poses that err."""
        measured = measured_rows(rows)
        chain = next((row for row in measured if row["kind"] == "chain"), None)
        data = "not measured" if chain is None else _describe_chain(chain)
        gain = None if chain is None else chain["enet"]["psnr"] - BASE_PSNR_DB
        yield claim(
            "real_logs.kitti_psnr_gain", gain, ">=", 2.0, "dB", f"{data}; over {BASE_PSNR_DB} dB", _count(chain)
        )
        kernel = None if chain is None else 1 - chain["enet"]["kernel_3m"] / chain["gnet"]["kernel_3m"]
        yield claim("real_logs.kitti_kernel_cut", kernel, ">=", 0.3, "fraction", f"{data}; at 3 m", _count(chain))
        heldout = None if chain is None else chain["enet"]["psnr"] - chain["gnet"]["psnr"]
        yield claim("real_logs.kitti_enet_heldout", heldout, ">=", 0.0, "dB", data, _count(chain))
        gains = {row["log"]: row["auto"] - row["none"] for row in measured if row["kind"] == "effects"}
        # Noise of one run is about 0.05 dB; the effects may not cost more than that on any log.
        for log, effects_gain in (gains or {"not measured": None}).items():
            yield claim("real_logs.effects_gain", effects_gain, ">=", -0.05, "dB", log)
        yield from self._noise_claims([row for row in measured if row["kind"] == "pose_noise"])
        yield from make_race_claims(measured)

    def _noise_claims(self, rows: list[Row]) -> Iterator[Claim]:
        lost = sum(row["exact"] - row["noisy"] for row in rows)
        share = sum(row["refined"] - row["noisy"] for row in rows) / lost if lost else None
        note = f"streets with {NOISE}, share of the PSNR that noise costs"
        yield claim("real_logs.pose_noise_recovered", share, ">=", 0.8, "fraction", note, len(rows))
        same = float(mean(row["exact_is_same"] for row in rows)) if rows else None
        note = "exact streets whose scene is the same bytes with the effect left to its gate"
        yield claim("real_logs.exact_streets_same", same, ">=", 1.0, "fraction", note, len(rows))

    def table(self, rows: Mapping[str, Row]) -> Iterator[str]:
        """Gives held-out PSNR with and without the effects, log by log, then the streets that err."""
        measured = measured_rows(rows)
        yield "| log | none | stereo | poses | both, by their gates |"
        yield "|---|---|---|---|---|"
        for row in measured:
            if row["kind"] == "effects":
                values = " | ".join(f"{row[name]:.2f}" for name in ("none", "stereo", "poses", "auto"))
                yield f"| {row['log']} | {values} |"
        yield ""
        yield "| street | exact | noisy | refined | misalignment, px |"
        yield "|---|---|---|---|---|"
        for row in measured:
            if row["kind"] == "pose_noise":
                values = " | ".join(f"{row[name]:.2f}" for name in ("exact", "noisy", "refined", "misalignment_px"))
                yield f"| {row['log']} | {values} |"
        yield ""
        yield from format_races(measured)
        yield from list_not_measured(rows)


def _describe_chain(row: Row) -> str:
    # Rows of earlier versions do not say what the images were.
    if "size_px" not in row:
        return str(row["log"])
    return f"{row['log']}, {row['cameras']} cameras at {row['size_px'][0]} x {row['size_px'][1]}"


def _count(row: Row | None) -> int:
    return 0 if row is None else 1


BENCH: Bench = RealLogsBench()
