"""Table 8 as a flow: detectors trained on recorded images alone and with renders, row after row and seed after seed."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from statistics import mean
from typing import Any

from prefect import flow, task
from prefect.cache_policies import NO_CACHE

from flows.configuration import load_configuration
from flows.experiments.log_chunks import LogChunk, select_log_chunks
from flows.experiments.result_files import machine_facts, write_text
from flows.experiments.stages import run_reported_stage
from flows.paper_tables.detector_study import ROWS, DetectorStudy
from flows.paper_tables.layouts import PROTOCOL
from flows.paper_tables.published_numbers import PAPER
from flows.pipeline.log_cache import cached_log
from flows.pipeline.progress import get_reporter
from genre_tasks.detection3d.settings import MOST_STEPS, Detector3dConfig
from genre_tasks.errors import ConfigError
from storage.opening import open_store

NUMBER = 8
_COLUMNS = {"map": "mAP", "ap_1m": "AP@1m", "ap_2m": "AP@2m", "ap_4m": "AP@4m"}
_TESTED = {"recorded": "recorded images", "shifted": "true images at the shift of the renders"}


@dataclass(frozen=True)
class DetectorRequest:
    """What a user asks of table 8.

    Attributes:
        train: URIs of logs to train on.
        test: URIs of other logs to test on.
        preset: name of the preset.
        store: folder of the store.
        chunks: of each log; all if ``None``.
        settings: ``section.key=value`` over the preset and the paper's protocol.
        seeds: trainings of each row.
        steps: gradient steps of a training; ``None``: as the detector's settings have them.
        out: folder to write into.
    """

    train: tuple[str, ...]
    test: tuple[str, ...]
    preset: str = "small"
    store: str = "genre-store"
    chunks: tuple[int, ...] | None = None
    settings: tuple[str, ...] = ()
    seeds: int = 3
    steps: int | None = None
    out: str = "tables"

    def check(self) -> DetectorStudy:
        """Finds logs and chunks.

        Raises:
            ConfigError: a log is missing among those to train or to test on, or is among both.
            InputError: a log or chunk does not exist.
        """
        if not self.train or not self.test:
            raise ConfigError(
                "table 8 needs logs to train on and others to test on",
                remedy="Give the first as arguments, and the others by --test, which may be given several times.",
            )
        # The protocol decides how long a chunk is.
        config = load_configuration(self.preset, settings=(*PROTOCOL, *self.settings))
        chunks = None if self.chunks is None else list(self.chunks)
        train = select_log_chunks(self.train, chunks, config)
        test = select_log_chunks(self.test, chunks, config)
        # A detector knows the images that it was trained on by heart. Two URIs may be one log: spelled by another path,
        # or with a parameter that is the default.
        trained_on = {cached_log(log).digest() for log in dict.fromkeys(where.log for where in train)}
        for log in dict.fromkeys(where.log for where in test):
            if cached_log(log).digest() in trained_on:
                raise ConfigError(f"{log} is among the logs to train on and to test on", remedy="Leave it out of one.")
        if self.seeds < 1:
            raise ConfigError(f"there are {self.seeds} seeds", remedy="Give --seeds 1 or more.")
        if self.steps is not None and not 1 <= self.steps <= MOST_STEPS:
            raise ConfigError(
                f"a training of {self.steps} steps is asked for", remedy=f"Give --steps 1 to {MOST_STEPS}."
            )
        detector = Detector3dConfig() if self.steps is None else Detector3dConfig(steps=self.steps)
        return DetectorStudy(
            train=tuple(train),
            test=tuple(test),
            preset=self.preset,
            settings=self.settings,
            store=self.store,
            shift_m=3.0,
            detector=detector,
            folder=Path(self.out) / "detectors",
        )


@flow(name="detector-table", persist_result=False, validate_parameters=False)
def detector_table(
    train: list[str],
    test: list[str],
    preset: str = "small",
    store: str = "genre-store",
    chunks: list[int] | None = None,
    settings: list[str] | None = None,
    seeds: int = 3,
    steps: int | None = None,
    out: str = "tables",
) -> dict[str, Any]:
    """Measures table 8: scenes of the training logs, trainings of every row and seed, and their scores.

    Stages come from the store and finished trainings from the output folder: killed at any point, it goes on where it
    was.

    Args:
        train: URIs of logs to train on.
        test: URIs of other logs to test on.
        preset: name of the preset.
        store: folder of the store.
        chunks: of each log; all if ``None``.
        settings: ``section.key=value`` over the preset and the paper's protocol.
        seeds: trainings of each row.
        steps: gradient steps of a training.
        out: folder to write into.

    Returns:
        ``trainings``, their number, and ``files`` that were written.

    Raises:
        GenreError: the request is wrong, or a stage or training fails.
    """
    chosen = None if chunks is None else tuple(chunks)
    request = DetectorRequest(
        train=tuple(train),
        test=tuple(test),
        preset=preset,
        store=store,
        chunks=chosen,
        settings=tuple(settings or ()),
        seeds=seeds,
        steps=steps,
        out=out,
    )
    study = request.check()
    # What killed runs left behind would only take space.
    open_store(store).clean_temporaries()
    reporter = get_reporter()
    scores: dict[str, list[dict[str, dict[str, float]]]] = {row: [] for row in ROWS}
    # Seed by seed, so that a stopped table has all rows of the first seeds.
    planned = [(row, seed) for seed in range(seeds) for row in ROWS]
    for k, (row, seed) in enumerate(planned):
        reporter.part_started(f"{k + 1}/{len(planned)} {ROWS[row]} · seed {seed}")
        found = training_task(study, row, seed)
        scores[row].append(found)
        reporter.part_ended(f"mAP {found['recorded']['map']:.3f} on recorded images")
    files = write_results(request, study, scores)
    return {"trainings": len(planned), "files": files}


@task(name="detector-training", task_run_name="{row} seed {seed}", persist_result=False, cache_policy=NO_CACHE)
def training_task(study: DetectorStudy, row: str, seed: int) -> dict[str, dict[str, float]]:
    """Runs one training as a Prefect task, see :meth:`DetectorStudy.measure`.

    Args:
        study: what is trained and tested.
        row: a key of ``ROWS``.
        seed: of the training.
    """
    return study.measure(row, seed, run_reported_stage, get_reporter().progress)


def write_results(
    request: DetectorRequest, study: DetectorStudy, scores: dict[str, list[dict[str, dict[str, float]]]]
) -> list[str]:
    """Writes ``table8_DATASET.json`` and ``.md``, each whole or not at all.

    Args:
        request: what the user asked for.
        study: the same, checked.
        scores: of every seed, by row.

    Returns:
        The paths of the files.
    """
    out = Path(request.out)
    out.mkdir(parents=True, exist_ok=True)
    dataset = cached_log(study.test[0].log).dataset
    # Numbers without their logs, seeds and machine could not be measured again.
    facts = {
        "trained on": _describe(study.train),
        "tested on": _describe(study.test),
        "seeds": str(request.seeds),
        "steps": str(study.detector.steps),
        **machine_facts(),
    }
    files = [out / f"table{NUMBER}_{dataset}.{kind}" for kind in ("json", "md")]
    write_text(files[0], json.dumps({"facts": facts, "scores": scores}, indent=1, ensure_ascii=False) + "\n")
    write_text(files[1], render_page(scores, facts, dataset))
    return [str(path) for path in files]


def render_page(scores: dict[str, list[dict[str, dict[str, float]]]], facts: dict[str, str], dataset: str) -> str:
    """Writes the table as Markdown, the paper's numbers beside those on recorded images.

    Args:
        scores: of every seed, by row.
        facts: what the numbers are of.
        dataset: of the logs.
    """
    paper = PAPER[NUMBER]
    lines = [f"## Table {NUMBER} on {dataset}: {paper.caption}", ""]
    for tested, words in _TESTED.items():
        # Recorded logs have no truth at the shift.
        if not all(tested in found for runs in scores.values() for found in runs):
            continue
        lines += [f"Tested on {words}: mean over seeds (least–most)" + _PAPERS_NOTE.get(tested, "") + ".", ""]
        lines += ["| trained on | " + " | ".join(_COLUMNS.values()) + " |", "|---" * (1 + len(_COLUMNS)) + "|"]
        for row, label in ROWS.items():
            cells = []
            for name in _COLUMNS:
                values = [found[tested][name] for found in scores[row]]
                text = f"{mean(values):.3f} ({min(values):.3f}–{max(values):.3f})"
                cells.append(text + (f" / {paper.rows[label][name]:.3f}" if tested in _PAPERS_NOTE else ""))
            lines.append(f"| {label} | {' | '.join(cells)} |")
        lines.append("")
    lines += [
        "Not comparable with the paper's numbers: its detector is BEVFormer-tiny on PandaSet, this one is small and "
        "looks at single images.",
        "",
        *(f"* {name}: {value}" for name, value in facts.items()),
        "",
    ]
    return "\n".join(lines)


_PAPERS_NOTE = {"recorded": " / the paper's"}


def _describe(places: tuple[LogChunk, ...]) -> str:
    return ", ".join(map(str, places))
