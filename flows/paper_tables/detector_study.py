"""What renders are worth to a detector (paper Table 8): trained on recorded images alone, and with renders added.

Every training takes as many steps from the same first weights, so that rows differ in their images alone. A finished
training is found again by its images, settings and code; one that was stopped goes on at its last checkpoint.
"""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from flows.experiments.log_chunks import LogChunk
from flows.experiments.result_files import write_text
from flows.experiments.stages import StageRunner
from flows.paper_tables.builtin_methods import BUILT_IN
from flows.paper_tables.layouts import PROTOCOL
from flows.paper_tables.training_images import RenderSource, build_source, label_recorded, label_truth, render_shifted
from genre_tasks.detection3d.settings import Detector3dConfig
from genre_tasks.json_files import read_json_object
from genre_tasks.progress import Progress, silent
from storage.code_digest import code_digest

if TYPE_CHECKING:
    from genre_tasks.detection3d.average_precision import DetectionScores
    from genre_tasks.detection3d.detector import Detector3d
    from genre_tasks.training_sets.labelled_images import LabelledImage

ROWS = {"real": "Real", "real+3dgs": "Real + Sim (3DGS)", "real+genre+": "Real + Sim (GenRe+)"}
"""The paper's rows: recorded images, and what is added to them."""

_LazyImages = Callable[[], "list[LabelledImage]"]

_RECORDED = "genre+"
"""Whose chunk is read where recorded images are all that is needed: the chunk is the same for every method."""

TEST_EVERY = 2
TRUTH_EVERY = 4
"""Of recorded test images every second frame is used, of the truth beside the path, which is ray-cast, every fourth."""

_CODE = (
    "genre_tasks.detection3d.training",
    "genre_tasks.detection3d.evaluate",
    "genre_tasks.training_sets.label_boxes",
    "genre_tasks.render",
)


@dataclass(frozen=True)
class DetectorStudy:
    """What is trained and tested.

    Attributes:
        train: chunks to train on.
        test: chunks to test on, of other logs.
        preset: name of the preset that scenes are made by.
        settings: ``section.key=value`` over the preset and the paper's protocol.
        store: folder of the store.
        shift_m: renders are so many metres to the left and to the right.
        detector: settings of the detector; its seed is left to each training.
        folder: where trainings are kept.
    """

    train: tuple[LogChunk, ...]
    test: tuple[LogChunk, ...]
    preset: str
    settings: tuple[str, ...]
    store: str
    shift_m: float
    detector: Detector3dConfig
    folder: Path

    def measure(
        self, row: str, seed: int, runner: StageRunner, progress: Progress = silent
    ) -> dict[str, dict[str, float]]:
        """Trains a detector and tests it.

        Args:
            row: a key of ``ROWS``.
            seed: of its first weights and of the order of images.
            runner: runs one stage.
            progress: called with the training's steps.

        Returns:
            Scores on ``recorded`` images and, of logs with a truth, on ``shifted`` ones: ``map``, ``ap_1m`` and so
            on, and ``boxes``, their number.

        Raises:
            InputError: a log has no annotations, or no box that counts.
            NonFiniteError: the training diverges.
        """
        from genre_tasks.detection3d.evaluate import evaluate_detector
        from genre_tasks.detection3d.training import train_detector

        images, names = self._collect_training_images(row, runner)
        config = self.detector.model_copy(update={"seed": seed})
        folder = self.folder / self._digest(config, names)
        scores_file = folder / "scores.json"
        if scores_file.is_file():
            return dict(read_json_object(scores_file, "the detector's scores", "Delete it, and run again."))
        detector: Detector3d = train_detector(images(), config, folder / "training.safetensors", progress)
        scores = {
            name: _name_scores(evaluate_detector(detector, tested), config.thresholds_m)
            for name, tested in self._collect_test_images(runner).items()
            if tested
        }
        write_text(scores_file, json.dumps(scores, indent=1) + "\n")
        return scores

    def build_source(self, where: LogChunk, method: str) -> RenderSource:
        """Builds the source of a chunk's images.

        Args:
            where: the chunk.
            method: a key of ``BUILT_IN`` that reconstructs it.
        """
        settings = (*PROTOCOL, *self.settings)
        return build_source(where, BUILT_IN[method], settings, self.preset, self.store)

    def _collect_training_images(self, row: str, runner: StageRunner) -> tuple[_LazyImages, list[str]]:
        """The images of a row, read when they are asked for, and what names them."""
        _, plus, method = row.partition("+")
        parts: list[_LazyImages] = []
        names = [row, f"{self.shift_m:g}"]
        for where in self.train:
            real = self.build_source(where, _RECORDED)
            ingest = runner("ingest", real.job, {})
            parts.append(partial(label_recorded, real.job, ingest))
            names.append(ingest.key)
            if plus:
                source = self.build_source(where, method)
                refs = source.run(runner)
                parts.append(partial(render_shifted, source, refs, (self.shift_m, -self.shift_m)))
                names.append(refs[str(source.end)].key)
        return (lambda: [image for part in parts for image in part()]), names

    def _collect_test_images(self, runner: StageRunner) -> dict[str, list[LabelledImage]]:
        found: dict[str, list[LabelledImage]] = {"recorded": [], "shifted": []}
        for where in self.test:
            source = self.build_source(where, _RECORDED)
            ingest = runner("ingest", source.job, {})
            found["recorded"] += label_recorded(source.job, ingest, TEST_EVERY)
            found["shifted"] += label_truth(source.job, ingest, (self.shift_m, -self.shift_m), TRUTH_EVERY)
        return found

    def _digest(self, config: Detector3dConfig, names: Sequence[str]) -> str:
        tested = [str(where) for where in self.test]
        code = code_digest(_CODE[0], lazy_modules=_CODE[1:])
        values = [config.model_dump(mode="json"), list(names), tested, TEST_EVERY, TRUTH_EVERY, code]
        return hashlib.sha256(json.dumps(values, sort_keys=True).encode()).hexdigest()[:24]


def _name_scores(scores: DetectionScores, thresholds_m: Sequence[float]) -> dict[str, float]:
    named = {"map": scores.mean_average_precision}
    named |= {f"ap_{threshold:g}m": scores.at_threshold(threshold) for threshold in thresholds_m}
    named |= {f"map_{kind.name}": kind.mean for kind in scores.classes if kind.truth_count}
    named["boxes"] = float(scores.truth_count)
    # JSON has no NaN: what was not measured is missing.
    return {name: value for name, value in named.items() if math.isfinite(value)}


def list_methods() -> tuple[str, ...]:
    """Lists the methods whose renders are trained on, keys of ``BUILT_IN``.

    >>> list_methods()
    ('3dgs', 'genre+')
    """
    return tuple(row.partition("+")[2] for row in ROWS if "+" in row)
