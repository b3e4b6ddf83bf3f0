"""What one setting brings: the initial scene and GNet's with it and without.

genre bench facades --json docs/results/data/facades.json [--set seeds=1001] [--set pandaset=]
genre bench ground --json docs/results/data/ground.json
python -m benchmarks.optimiser.ablation ground LOG STORE PICTURE.png    # scenes at ±3 m: without, with, truth
"""

from __future__ import annotations

import sys
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path

import torch
from PIL import Image

from benchmarks.common.bench import (
    TINY_SETTINGS,
    TINY_STREET,
    Cell,
    Row,
    SmallestForm,
    list_not_measured,
    logs_from_options,
    measured_rows,
    settings_from_options,
)
from benchmarks.common.claims import Claim
from benchmarks.common.context import THREADS, cell_label
from benchmarks.common.lazy_modules import STAGE_MODULES
from benchmarks.common.over_cells import claim_over_cells
from benchmarks.common.pipeline_inputs import render_images
from benchmarks.common.task import OptimisationTask, load_task
from benchmarks.optimiser import race
from flows.configuration import load_configuration
from flows.pipeline.definition import STAGE_BY_NAME, digest_stage_weights
from genre_tasks.config import GnetConfig
from genre_tasks.threads import torch_threads

KINDS = {"without": "false", "with": "true"}
CELL_S = 90.0
"""Predicted; most of it ray-casts a street's images."""


def measure(setting: str, log: str, chunk: int, store: str, over_preset: Sequence[str] = ()) -> Row:
    """Measures the initial scene and GNet's without and with a setting.

    Args:
        setting: a switch of the configuration.
        log: URI.
        chunk: index in the log.
        store: folder of the artifacts.
        over_preset: settings over the preset ``small``.

    Returns:
        PSNR in dB on held-out frames and at 3 m, and GNet's seconds, for each of ``KINDS``.
    """
    out: Row = {"log": log, "chunk": chunk}
    # Both kinds run on the same threads and one after the other, so their seconds compare.
    with torch_threads(THREADS):
        for kind, value in KINDS.items():
            task, gnet = _load_task_and_config(setting, value, log, chunk, store, over_preset)
            # Otherwise the first kind would pay for code that the second one finds loaded.
            race.warm_up(task, gnet, gnet.seed)
            end = race.run_learned(task, gnet, gnet.seed)[-1]
            out[kind] = {"initial": _psnr(task), "gnet": [end.psnr, end.beside], "gnet_s": end.seconds}
    return out


def _load_task_and_config(
    setting: str, value: str, log: str, chunk: int, store: str, over_preset: Sequence[str] = ()
) -> tuple[OptimisationTask, GnetConfig]:
    settings = (*over_preset, f"{setting}={value}")
    return load_task(log, chunk, store, *settings), load_configuration("small", settings=settings).gnet


def _psnr(task: OptimisationTask) -> list[float | None]:
    return [task.psnr(task.scene), task.psnr_novel(task.scene)]


@dataclass
class SwitchAblation:
    """Benchmark of one switch of the configuration, with a cell for each log.

    Attributes:
        name: of the benchmark.
        setting: the switch.
        subject: what it is called in tables.
        options: of the command line, with their defaults.
        code: modules that the rows depend on.
        smallest: options of the shortest run.
    """

    name: str
    setting: str
    subject: str
    options: Mapping[str, str] = field(
        default_factory=lambda: {
            "seeds": "1001,1002,1003",
            "store": "genre-store",
            "pandaset": "../shared/data/pandaset/002",
            "settings": "",
        }
    )
    code: tuple[str, ...] = (
        "benchmarks.optimiser.ablation",
        # It scores the scenes.
        "flows.training.optimiser_training",
        *STAGE_MODULES,
        "genre_tasks.logs.pandaset.reader",
        "genre_tasks.logs.synthetic",
    )
    smallest: SmallestForm = field(
        default_factory=lambda: SmallestForm(
            {"seeds": TINY_STREET, "pandaset": "", "settings": TINY_SETTINGS}, only="street"
        )
    )

    def cells(self, options: Mapping[str, str], quick: bool) -> list[Cell]:
        """``quick``: one street. An empty ``pandaset`` leaves the real log out."""
        logs = logs_from_options(options)
        settings = settings_from_options(options)
        small = load_configuration("small", settings=settings)
        # The weights are in the key, so that a new training measures again.
        parameters = {
            "configuration": small.model_dump(mode="json"),
            "weights": digest_stage_weights(STAGE_BY_NAME["gnet"], small),
        }
        run = partial(measure, self.setting)
        return [
            Cell(f"{log} chunk {chunk}", CELL_S, partial(run, log, chunk, options["store"], settings), parameters)
            for log, chunk in (logs[:1] if quick else logs)
        ]

    def claims(self, rows: Mapping[str, Row]) -> Iterator[Claim]:
        """Medians of what GNet gains over the streets, and the real chunk's gain."""
        found = measured_rows(rows)
        streets = [row for row in found if row["log"].startswith("synthetic:")]
        reals = [row for row in found if row not in streets]
        sets = (("street_heldout_db", streets, 0), ("street_3m_db", streets, 1), ("real_heldout_db", reals, 0))
        # Only streets have truth at 3 m; the real log has a claim of its own on held-out frames.
        for name, cells, k in sets:
            gains = [row["with"]["gnet"][k] - row["without"]["gnet"][k] for row in cells]
            data = f"GNet's PSNR, {self.subject} less without; {', '.join(map(cell_label, cells)) or 'not measured'}"
            yield claim_over_cells(name, gains, ">", 0.0, "dB", data, bench=self.name)

    def table(self, rows: Mapping[str, Row]) -> Iterator[str]:
        """A line for each log and kind."""
        yield f"| log | {self.subject} | initial: held out | at 3 m | GNet: held out | at 3 m | GNet, s |"
        yield "|---|---|---|---|---|---|---|"
        for row in measured_rows(rows):
            for kind in KINDS:
                found = row[kind]
                cells = ["" if x is None else f"{x:.2f}" for x in (*found["initial"], *found["gnet"])]
                yield f"| {cell_label(row)} | {kind} | {' | '.join(cells)} | {found['gnet_s']:.2f} |"
        yield from list_not_measured(rows)


def save_comparison(setting: str, log: str, store: str, path: Path) -> None:
    """Saves renders at three novel views of a synthetic log's chunk 0: without the setting, with it, and the truth.

    Args:
        setting: a switch of the configuration.
        log: URI.
        store: folder of the artifacts.
        path: file to write.
    """
    columns = []
    for value in KINDS.values():
        task, gnet = _load_task_and_config(setting, value, log, 0, store)
        views = task.novel_targets[:: max(1, len(task.novel_targets) // 3)][:3]
        end = race.take_last(race.gnet_steps(task, gnet, gnet.seed), gnet.iterations)
        columns.append(render_images(end.scene, views).flatten(0, 1))
    # The truth comes last, beside the setting that should look like it.
    columns.append(torch.cat([view.image.pixels for view in views]))
    Image.fromarray((torch.cat(columns, 1) * 255).round().byte().numpy()).save(path)


FACADES = SwitchAblation("facades", "ingest.complete_facades", "façades completed")
GROUND = SwitchAblation("ground", "gnet.constrain_ground", "ground held")

if __name__ == "__main__":
    setting = {bench.name: bench.setting for bench in (FACADES, GROUND)}[sys.argv[1]]
    save_comparison(setting, sys.argv[2], sys.argv[3], Path(sys.argv[4]))
