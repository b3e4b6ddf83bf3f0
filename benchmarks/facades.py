"""What completing façades above the LiDAR's view brings: the initial scene and GNet's with it and without.

genre bench facades --json docs/benchmarks/facades.json [--set seeds=1001] [--set pandaset=]
python -m benchmarks.facades LOG STORE PICTURE.png    # GNet's scene at ±3 m: without, with, and the truth
"""

from __future__ import annotations

import itertools
import sys
from collections.abc import Iterator, Mapping
from functools import partial
from pathlib import Path

import torch
from PIL import Image

from benchmarks.bench import Bench, Cell, Row, logs_of
from benchmarks.optimiser import race
from benchmarks.optimiser.beyond import over_cells
from benchmarks.optimiser.cells import place, threads
from benchmarks.optimiser.steps import images_of
from benchmarks.optimiser.task import Task, task_of
from benchmarks.schema import Claim
from flows.configuration import load_configuration
from flows.pipeline import BY_NAME, weights_digest, weights_file

KINDS = {"without": "ingest.walls=false", "with": "ingest.walls=true"}
CELL_S = 90.0
"""Predicted; most of it ray-casts a street's images."""


def measure(log: str, chunk: int, store: str) -> Row:
    """PSNR in dB on held-out frames and at 3 m, of the initial scene and of GNet's, and GNet's seconds."""
    gnet = load_configuration("small").gnet
    out: Row = {"log": log, "chunk": chunk}
    with threads():
        for kind, setting in KINDS.items():
            task = task_of(log, chunk, store, setting)
            end = race.learned(task, gnet, gnet.seed)[-1]
            out[kind] = {"initial": _psnr(task), "gnet": [end.psnr, end.beside], "gnet_s": end.seconds}
    return out


def _psnr(task: Task) -> list[float | None]:
    return [task.psnr(task.scene), task.psnr_beside(task.scene)]


class Facades:
    """A cell for each log."""

    name = "facades"
    options: Mapping[str, str] = {
        "seeds": "1001,1002,1003", "store": "genre-store", "pandaset": "../shared/data/pandaset/002",
    }  # fmt: skip
    code: tuple[str, ...] = (
        "benchmarks.facades", "genre_tasks.optimiser.run", "genre_tasks.stages.ingest", "genre_tasks.stages.initial",
        "genre_tasks.logs.pandaset", "genre_tasks.logs.synthetic",
    )  # fmt: skip

    def cells(self, options: Mapping[str, str], quick: bool) -> list[Cell]:
        """``quick``: one street. An empty ``pandaset`` leaves the real log out."""
        logs = logs_of(options)
        small = load_configuration("small")
        parameters = {
            "configuration": small.model_dump(mode="json"),
            "weights": weights_digest(weights_file(BY_NAME["gnet"], small)),
        }
        return [
            Cell(f"{log} chunk {chunk}", CELL_S, partial(measure, log, chunk, options["store"]), parameters)
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
            data = f"GNet's PSNR with façades completed less without; {', '.join(map(place, of)) or 'not measured'}"
            yield over_cells(name, gains, ">", 0.0, "dB", data, bench=self.name)

    def table(self, rows: Mapping[str, Row]) -> Iterator[str]:
        """A line for each log and kind."""
        yield "| log | façades | initial: held out | at 3 m | GNet: held out | at 3 m | GNet, s |"
        yield "|---|---|---|---|---|---|---|"
        for row in (r for r in rows.values() if "not_measured" not in r):
            for kind in KINDS:
                found = row[kind]
                cells = ["" if x is None else f"{x:.2f}" for x in (*found["initial"], *found["gnet"])]
                yield f"| {place(row)} | {kind} | {' | '.join(cells)} | {found['gnet_s']:.2f} |"
        for name in (n for n, r in rows.items() if "not_measured" in r):
            yield f"\n{name}: not measured: {rows[name]['not_measured']}"


def picture(log: str, store: str, path: Path) -> None:
    """A row for each of three views beside the path of a synthetic log's chunk 0: without, with, and the truth."""
    gnet, columns = load_configuration("small").gnet, []
    for setting in KINDS.values():
        task = task_of(log, 0, store, setting)
        views = task.beside[:: max(1, len(task.beside) // 3)][:3]
        *_, end = itertools.islice(race.configured(task, gnet, gnet.seed), gnet.iterations)
        columns.append(images_of(end.scene, views).flatten(0, 1))
    columns.append(torch.cat([view.image.image for view in views]))
    Image.fromarray((torch.cat(columns, 1) * 255).round().byte().numpy()).save(path)


BENCH: Bench = Facades()

if __name__ == "__main__":
    picture(sys.argv[1], sys.argv[2], Path(sys.argv[3]))
