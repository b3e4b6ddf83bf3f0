"""What renders are worth to a detector (paper Table 8): trained on recorded images alone, and with renders added.

Every training takes as many steps from the same first weights, so that rows differ in their images alone. Recorded
images are half of those that a detector sees, however many renders are added.

A finished training is found again by its images, settings and code; one that was stopped goes on at its last
checkpoint.
"""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from flows.experiments.log_chunks import LogChunk
from flows.experiments.result_files import write_text
from flows.experiments.stages import StageRunner
from flows.machine.folder_lock import hold_training_folder
from flows.paper_tables.builtin_methods import BUILT_IN
from flows.paper_tables.cached_images import CachedImages, JoinedImages, digest_values
from flows.paper_tables.layouts import PROTOCOL
from flows.paper_tables.training_images import RenderSource, build_source, label_recorded, label_truth, render_shifted
from flows.pipeline.log_cache import cached_log
from genre_tasks.detection3d.settings import Detector3dConfig
from genre_tasks.errors import InputError
from genre_tasks.json_files import read_json_object
from genre_tasks.progress import Progress, silent

if TYPE_CHECKING:
    from genre_tasks.detection3d.average_precision import DetectionScores
    from genre_tasks.detection3d.detector import Detector3d
    from genre_tasks.training_sets.labelled_images import LabelledImage

ROWS = {"real": "Real", "real+3dgs": "Real + Sim (3DGS)", "real+genre+": "Real + Sim (GenRe+)"}
"""The paper's rows: recorded images, and what is added to them."""

_RECORDED = "genre+"
"""Whose chunk is read where recorded images are all that is needed: the chunk is the same for every method."""

TEST_EVERY = 2
TRUTH_EVERY = 4
"""Of recorded test images every second frame is used, of the truth beside the path, which is ray-cast, every fourth."""

_TRAINING_CODE = ("genre_tasks.detection3d.training", "genre_tasks.detection3d.evaluate")


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
            InputError: a log has no annotations, no image to train or to test on has a box that counts, or another
                process runs the same training.
            NonFiniteError: the training diverges.
        """
        from genre_tasks.detection3d.detector import save_detector
        from genre_tasks.detection3d.evaluate import evaluate_detector
        from genre_tasks.detection3d.training import train_detector

        # Scenes first: they take longest, and fail first if something is wrong.
        sets = self._list_training_sets(row, runner)
        tested = self._list_test_sets(runner)
        # The seed is part of the key, so that every training has a folder of its own.
        config = self.detector.model_copy(update={"seed": seed})
        # Keys of sets follow from all that their images follow from.
        names = [*(part.key for part in sets), *(joined.key for joined in tested.values())]
        key = digest_values((config.model_dump(mode="json"), names), _TRAINING_CODE)
        folder = self.folder / "trainings" / key
        scores_file = folder / "scores.json"
        if scores_file.is_file():
            return dict(read_json_object(scores_file, "the detector's scores", "Delete it, and run again."))
        images = [image for part in sets for image in part.read()]
        test_images = {name: joined.read() for name, joined in tested.items()}
        # Before a training of minutes, after which there would be nothing to score.
        for name, held in test_images.items():
            _require_boxes(held, config, name)
        with hold_training_folder(folder):
            detector: Detector3d = train_detector(images, config, folder / "training.safetensors", progress)
            save_detector(detector, folder / "detector.safetensors")
        scores = {}
        for name, held in test_images.items():
            scores[name] = _name_scores(evaluate_detector(detector, held), config.thresholds_m)
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

    def _list_training_sets(self, row: str, runner: StageRunner) -> list[CachedImages]:
        """The training sets of a row: recorded images of every chunk, and its renders."""
        _, plus, method = row.partition("+")
        sets = []
        shifts = (self.shift_m, -self.shift_m)
        for where in self.train:
            # As often as renders, which there are of every shift: the test is on recorded images.
            sets += [self._cache_recorded(where, runner, every=1)] * (len(shifts) if plus else 1)
            if plus:
                source = self.build_source(where, method)
                refs = source.run(runner)
                names = ("renders", refs["ingest"].key, refs["effects"].key, refs[str(source.end)].key, shifts)
                sets.append(CachedImages.named(self.folder, names, partial(render_shifted, source, refs, shifts)))
        return sets

    def _list_test_sets(self, runner: StageRunner) -> dict[str, JoinedImages]:
        """The test sets by name; that of shifted images only where every log has a truth."""
        # Recorded test images lie on the path, as in the paper.
        recorded = [self._cache_recorded(where, runner, TEST_EVERY) for where in self.test]
        sets = {"recorded": JoinedImages(tuple(recorded))}
        # Half of a test set would be another test.
        if all(cached_log(where.log).truth is not None for where in self.test):
            sets["shifted"] = JoinedImages(tuple(self._cache_truth(where, runner) for where in self.test))
        return sets

    def _cache_recorded(self, where: LogChunk, runner: StageRunner, every: int) -> CachedImages:
        job = self.build_source(where, _RECORDED).job
        ingest = runner("ingest", job, {})
        names = ("recorded", ingest.key, every)
        return CachedImages.named(self.folder, names, partial(label_recorded, job, ingest, every))

    def _cache_truth(self, where: LogChunk, runner: StageRunner) -> CachedImages:
        job = self.build_source(where, _RECORDED).job
        ingest = runner("ingest", job, {})
        shifts = (self.shift_m, -self.shift_m)
        names = ("truth", ingest.key, shifts, TRUTH_EVERY)
        return CachedImages.named(self.folder, names, partial(label_truth, job, ingest, shifts, TRUTH_EVERY))


def _require_boxes(images: Sequence[LabelledImage], config: Detector3dConfig, name: str) -> None:
    from genre_tasks.detection3d.examples import select_boxes

    if not any(select_boxes(image, config) for image in images):
        labels = ", ".join(kind.name for kind in config.classes)
        raise InputError(
            f"no {name} image of the logs to test on has a box of {labels} that counts",
            remedy="Choose other logs to test on: boxes have to be in the image, within range and seen by LiDAR.",
            log=images[0].log if images else None,
        )


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
