"""Table 8 as claims: a detector of boxes trained on recorded images, and with renders added."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import mean

import torch

from benchmarks.common.bench import Row
from benchmarks.common.claims import Claim, claim
from benchmarks.common.run_stages import print_progress
from benchmarks.perception.scenes import METHOD
from flows.experiments.log_chunks import LogChunk
from flows.paper_tables.builtin_methods import BUILT_IN
from flows.paper_tables.detector_study import ROWS, DetectorStudy
from flows.paper_tables.layouts import PROTOCOL
from flows.pipeline.definition import STAGE_BY_NAME, digest_stage_weights
from flows.pipeline.stage_runner import run_stage
from genre_tasks.config import PipelineConfig
from genre_tasks.detection3d.settings import Detector3dConfig

SHIFT_M = 3.0
TESTED = ("recorded", "shifted")
"""The images that a trained detector is tested on: those of the log, and renders beside its path."""

_NUMBERS = ("map", "ap_1m", "ap_2m", "ap_4m")


@dataclass(frozen=True)
class TrainingCase:
    """What is trained and tested.

    Attributes:
        train: logs to train on, all of chunk 0.
        test: logs to test on.
        settings: ``section.key=value`` over the preset ``small`` and the paper's protocol.
        store: folder of the store.
        steps: of a training.
        max_occluded: boxes of renders of which nearer surfaces hide more are not trained on.
        folder: where trainings are kept.
    """

    train: tuple[str, ...]
    test: tuple[str, ...]
    settings: tuple[str, ...]
    store: str
    steps: int
    max_occluded: float
    folder: Path

    @property
    def detector(self) -> Detector3dConfig:
        """The detector's settings."""
        return Detector3dConfig(steps=self.steps, max_occluded=self.max_occluded)

    def describe(self, row: str) -> dict[str, object]:
        """Says what a training depends on beyond the code, for the cells' cache.

        Args:
            row: a key of ``ROWS``.
        """
        # Recorded images come from a chunk of this method's, whatever is added to them.
        names = (METHOD, *row.split("+", 1)[1:])
        configurations = {
            name: BUILT_IN[name].configuration("small", (*PROTOCOL, *self.settings)).model_dump(mode="json")
            for name in names
        }
        config = PipelineConfig.model_validate(configurations[METHOD])
        weights = [digest_stage_weights(STAGE_BY_NAME[stage], config) for stage in ("gnet", "fnet", "enet")]
        return {
            "train": list(self.train),
            "test": list(self.test),
            "detector": self.detector.model_dump(mode="json"),
            "configurations": configurations,
            "weights": weights,
        }


def measure_training(case: TrainingCase, row: str, seed: int) -> Row:
    """Trains and tests one detector.

    Args:
        case: logs and settings.
        row: a key of ``ROWS``.
        seed: of the training.

    Returns:
        ``scores``: by test set, see :meth:`DetectorStudy.measure`.
    """
    # The product's own study, so that the claim is about what users run.
    study = DetectorStudy(
        train=tuple(LogChunk(log, 0) for log in case.train),
        test=tuple(LogChunk(log, 0) for log in case.test),
        preset="small",
        settings=case.settings,
        store=case.store,
        shift_m=SHIFT_M,
        detector=case.detector,
        folder=case.folder,
    )

    def report(done: int, total: int, note: str = "") -> None:
        # A line a step would bury what other cells print.
        if done % 100 == 0:
            print_progress(f"training {row} seed {seed}: {done} of {total}, {note}")

    # Training leaves one thread, and later cells need them all.
    threads = torch.get_num_threads()
    scores = study.measure(row, seed, run_stage, report)
    torch.set_num_threads(threads)
    return {
        "kind": "training",
        "images": row,
        "seed": seed,
        "train_logs": len(case.train),
        "test_logs": len(case.test),
        "steps": case.steps,
        "max_occluded": case.max_occluded,
        "scores": scores,
    }


def training_claims(rows: Sequence[Row]) -> Iterator[Claim]:
    """Claims that renders of GenRe+ help by more than the spread over seeds, on recorded images and on moved ones.

    Args:
        rows: see :func:`measure_training`.
    """
    if not rows:
        for name in (f"training_{tested}_{kind}" for tested in TESTED for kind in ("gain", "beyond_spread")):
            yield claim(f"perception.{name}", None, ">", 0.0, "mAP", "not measured")
    for size in list_sizes(rows):
        of_size = [row for row in rows if size_of(row) == size]
        for tested in TESTED:
            base = list_scores(of_size, "real", tested, "map")
            ours = list_scores(of_size, "real+genre+", tested, "map")
            gain = mean(ours) - mean(base) if ours and base else None
            # The larger range over seeds of the two rows has to be less than what is gained.
            beyond = None if gain is None else gain - max(max(values) - min(values) for values in (ours, base))
            trained = f"trained on {size[0]} streets for {size[1]} steps, boxes hidden up to {size[2]:g}"
            note = f"{trained}, {tested} images, mean over {len(ours)} seeds, Real + Sim (GenRe+) less Real"
            name = f"perception.training_{tested}"
            yield claim(f"{name}_gain", gain, ">", 0.0, "mAP", note, len(ours))
            ranged = f"{note}, less the larger range over seeds"
            yield claim(f"{name}_beyond_spread", beyond, ">", 0.0, "mAP", ranged, len(ours))


def size_of(row: Row) -> tuple[int, int, float]:
    """Gives the size of a training: number of streets, steps, and how much of a box may be hidden.

    Args:
        row: see :func:`measure_training`.
    """
    return row["train_logs"], row["steps"], row.get("max_occluded", 1.0)


def list_sizes(rows: Sequence[Row]) -> list[tuple[int, int, float]]:
    """Lists the sizes of trainings.

    Args:
        rows: see :func:`measure_training`.
    """
    return sorted({size_of(row) for row in rows}, reverse=True)


def list_scores(rows: Sequence[Row], images: str, tested: str, name: str) -> list[float]:
    """Lists a score of every seed.

    Args:
        rows: see :func:`measure_training`.
        images: a key of ``ROWS``.
        tested: ``recorded`` or ``shifted``.
        name: ``map``, ``ap_1m``, ``ap_2m`` or ``ap_4m``.
    """
    found = [row["scores"].get(tested, {}) for row in rows if row["images"] == images]
    return [float(scores[name]) for scores in found if name in scores]


def training_table(rows: Sequence[Row]) -> Iterator[str]:
    """Gives the mean over seeds with its range, a line for each row of the paper and test set.

    Args:
        rows: see :func:`measure_training`.
    """
    yield "| streets, steps, hidden up to | trained on | tested on | mAP | AP@1m | AP@2m | AP@4m | seeds |"
    yield "|---|---|---|---|---|---|---|---|"
    for size in list_sizes(rows):
        of_size = [row for row in rows if size_of(row) == size]
        for tested in TESTED:
            # In the paper's order.
            for images, label in ROWS.items():
                texts = []
                for name in _NUMBERS:
                    values = list_scores(of_size, images, tested, name)
                    texts.append(f"{mean(values):.3f} ({min(values):.3f}–{max(values):.3f})" if values else "–")
                count = len(list_scores(of_size, images, tested, "map"))
                yield f"| {size[0]}, {size[1]}, {size[2]:g} | {label} | {tested} | {' | '.join(texts)} | {count} |"
