"""What one setting brings: the initial scene and GNet's with it and without.

genre bench facades --json docs/benchmarks/facades.json [--set seeds=1001] [--set pandaset=]
genre bench ground --json docs/benchmarks/ground.json
python -m benchmarks.optimiser.ablation ground LOG STORE PICTURE.png    # scenes at ±3 m: without, with, truth
"""

from __future__ import annotations

import sys
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path

import torch
from PIL import Image

from benchmarks.common.bench import Cell, Row, logs_of
from benchmarks.common.claims import Claim
from benchmarks.common.context import place, threads
from benchmarks.common.over_cells import over_cells
from benchmarks.common.pipeline_inputs import images_of
from benchmarks.common.task import Task, task_of
from benchmarks.optimiser import race
from flows.configuration import load_configuration
from flows.pipeline.definition import BY_NAME, stage_weights
from genre_tasks.config import GnetConfig

KINDS = {"without": "false", "with": "true"}
CELL_S = 90.0
"""Predicted; most of it ray-casts a street's images."""


def measure(setting: str, log: str, chunk: int, store: str) -> Row:
    """PSNR in dB on held-out frames and at 3 m, of the initial scene and of GNet's, and GNet's seconds."""
    out: Row = {"log": log, "chunk": chunk}
    with threads():
        for kind, value in KINDS.items():
            task, gnet = _posed(setting, value, log, chunk, store)
            end = race.learned(task, gnet, gnet.seed)[-1]
            out[kind] = {"initial": _psnr(task), "gnet": [end.psnr, end.beside], "gnet_s": end.seconds}
    return out


def _posed(setting: str, value: str, log: str, chunk: int, store: str) -> tuple[Task, GnetConfig]:
    told = f"{setting}={value}"
    return task_of(log, chunk, store, told), load_configuration("small", settings=[told]).gnet


def _psnr(task: Task) -> list[float | None]:
    return [task.psnr(task.scene), task.psnr_beside(task.scene)]


@dataclass
class WithWithout:
    """A cell for each log. ``setting``: a switch of the configuration; ``subject``: what it is called in tables."""

    name: str
    setting: str
    subject: str
    options: Mapping[str, str] = field(
        default_factory=lambda: {
            "seeds": "1001,1002,1003",
            "store": "genre-store",
            "pandaset": "../shared/data/pandaset/002",
        }
    )
    code: tuple[str, ...] = (
        "benchmarks.optimiser.ablation",
        "genre_tasks.stages.optimise",
        "genre_tasks.stages.ingest",
        "genre_tasks.stages.initial",
        "genre_tasks.logs.pandaset.reader",
        "genre_tasks.logs.synthetic",
    )

    def cells(self, options: Mapping[str, str], quick: bool) -> list[Cell]:
        """``quick``: one street. An empty ``pandaset`` leaves the real log out."""
        logs = logs_of(options)
        small = load_configuration("small")
        parameters = {
            "configuration": small.model_dump(mode="json"),
            "weights": stage_weights(BY_NAME["gnet"], small),
        }
        run = partial(measure, self.setting)
        return [
            Cell(f"{log} chunk {chunk}", CELL_S, partial(run, log, chunk, options["store"]), parameters)
            for log, chunk in (logs[:1] if quick else logs)
        ]

    def claims(self, rows: Mapping[str, Row]) -> Iterator[Claim]:
        """Medians of what GNet gains over the streets, and the real chunk's gain."""
        found = [row for row in rows.values() if "not_measured" not in row]
        streets = [row for row in found if row["log"].startswith("synthetic:")]
        reals = [row for row in found if row not in streets]
        sets = (("street_heldout_db", streets, 0), ("street_3m_db", streets, 1), ("real_heldout_db", reals, 0))
        for name, of, k in sets:
            gains = [row["with"]["gnet"][k] - row["without"]["gnet"][k] for row in of]
            data = f"GNet's PSNR, {self.subject} less without; {', '.join(map(place, of)) or 'not measured'}"
            yield over_cells(name, gains, ">", 0.0, "dB", data, bench=self.name)

    def table(self, rows: Mapping[str, Row]) -> Iterator[str]:
        """A line for each log and kind."""
        yield f"| log | {self.subject} | initial: held out | at 3 m | GNet: held out | at 3 m | GNet, s |"
        yield "|---|---|---|---|---|---|---|"
        for row in (r for r in rows.values() if "not_measured" not in r):
            for kind in KINDS:
                found = row[kind]
                cells = ["" if x is None else f"{x:.2f}" for x in (*found["initial"], *found["gnet"])]
                yield f"| {place(row)} | {kind} | {' | '.join(cells)} | {found['gnet_s']:.2f} |"
        for name in (n for n, r in rows.items() if "not_measured" in r):
            yield f"\n{name}: not measured: {rows[name]['not_measured']}"


def picture(setting: str, log: str, store: str, path: Path) -> None:
    """A row for each of three views beside the path of a synthetic log's chunk 0: without, with, and the truth."""
    columns = []
    for value in KINDS.values():
        task, gnet = _posed(setting, value, log, 0, store)
        views = task.beside[:: max(1, len(task.beside) // 3)][:3]
        end = race.at_end(race.configured(task, gnet, gnet.seed), gnet.iterations)
        columns.append(images_of(end.scene, views).flatten(0, 1))
    columns.append(torch.cat([view.image.image for view in views]))
    Image.fromarray((torch.cat(columns, 1) * 255).round().byte().numpy()).save(path)


FACADES = WithWithout("facades", "ingest.complete_facades", "façades completed")
GROUND = WithWithout("ground", "gnet.constrain_ground", "ground held")

if __name__ == "__main__":
    setting = {bench.name: bench.setting for bench in (FACADES, GROUND)}[sys.argv[1]]
    picture(setting, sys.argv[2], sys.argv[3], Path(sys.argv[4]))
