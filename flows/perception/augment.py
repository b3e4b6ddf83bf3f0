"""Training sets of finished runs: their scenes rendered next to the path, with moved boxes, and the recorded images."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from genre_tasks.errors import InputError
from genre_tasks.progress import Progress, silent

if TYPE_CHECKING:
    from flows.simulation.run_scenes import RunScenes
    from genre_tasks.logs.types import DrivingLog
    from genre_tasks.training_sets.labelled_images import LabelledImage
    from genre_tasks.training_sets.writing import WrittenSet

PartStarted = Callable[[str], None]


@dataclass(frozen=True)
class AugmentRequest:
    """What a training set is made of.

    Attributes:
        store: folder (or URI) of the store.
        runs: names of finished runs, or the starts of them.
        shifts_m: metres to the left.
        format_name: the layout's name.
        out: the new folder.
        stage: initial, gnet or enet; ``None``: the last one of each chunk.
        every: every n-th frame is taken.
        recorded: whether the recorded images are among the set's.
        min_points: LiDAR points that a box needs.
    """

    store: str
    runs: Sequence[str]
    shifts_m: Sequence[float]
    format_name: str
    out: Path
    stage: str | None = None
    every: int = 1
    recorded: bool = True
    min_points: int = 1


def augment_runs(
    request: AugmentRequest, progress: Progress = silent, part_started: PartStarted | None = None
) -> WrittenSet:
    """Writes one training set of all chunks of runs.

    Args:
        request: what it is made of.
        progress: called with the images of a chunk that are done and their total.
        part_started: called with a title before each chunk.

    Returns:
        How much was written.

    Raises:
        InputError: there is no such run or stage, a run is there twice or has edited traffic, a log is gone or has no
            annotations, two runs have the same chunk, or the folder holds something already.
        ConfigError: there is no such format.
        ResourceError: the disk is full or not writable.
    """
    from genre_tasks.training_sets.writing import check_new_folder, check_training_set_format, write_training_set

    # Checked first, because rendering takes minutes.
    check_training_set_format(request.format_name)
    check_new_folder(request.out)
    sources = _open_sources(request)
    images = _render_sources(request, sources, progress, part_started or (lambda title: None))
    return write_training_set(images, request.out, request.format_name)


def _open_sources(request: AugmentRequest) -> list[tuple[RunScenes, DrivingLog]]:
    from flows.simulation.run_scenes import RunScenes
    from genre_tasks.training_sets.label_boxes import labeller_of

    sources = []
    names: set[str] = set()
    digest_of: dict[str, str] = {}
    known: dict[tuple[str, int], str] = {}
    for run in request.runs:
        scenes = RunScenes(request.store, run, request.stage)
        name = str(scenes.record["run"])
        if name in names:
            raise InputError(f"the run {name} is there twice", remedy="Name each run once.")
        names.add(name)
        edited = scenes.record.get("edited")
        if edited is not None:
            # The log's annotation knows neither of removed actors nor of moved ones.
            problem = f"the traffic of the run {name} is edited, and the labels would be those of the recorded traffic"
            raise InputError(problem, remedy=f"Take the recorded run {edited['run']}.")
        log = scenes.log
        # Raises where there is nothing to label with.
        labeller_of(log)
        if digest_of.setdefault(log.name, log.digest()) != log.digest():
            # By its log's name a set tells where an image was taken.
            problem = f"two logs are called {log.name}"
            raise InputError(problem, remedy="Make a training set of each.", log=log.uri)
        for frame in _list_frames(scenes, log):
            other = known.setdefault((log.name, frame), name)
            # Two scenes of one place would put every recorded image into the set twice.
            if other != name:
                problem = f"the runs {other} and {name} both have frame {frame} of the log {log.name}"
                raise InputError(problem, remedy="Make a training set of each.", log=log.uri)
        sources.append((scenes, log))
    return sources


def _list_frames(scenes: RunScenes, log: DrivingLog) -> list[int]:
    from flows.reconstruction.chunk_configuration import read_chunk_config
    from genre_tasks.logs.log_selection import select_frames

    frames: list[int] = []
    for number in scenes.chunk_numbers:
        frames += select_frames(read_chunk_config(scenes.record, number).ingest, log, number)
    return frames


def _render_sources(
    request: AugmentRequest,
    sources: Sequence[tuple[RunScenes, DrivingLog]],
    progress: Progress,
    part_started: PartStarted,
) -> Iterator[LabelledImage]:
    from flows.perception.labelled_renders import render_labelled_images
    from flows.reconstruction.chunk_configuration import read_chunk_config
    from genre_tasks.training_sets.label_filter import keep_visible_boxes

    for scenes, log in sources:
        for number in scenes.chunk_numbers:
            part_started(f"{log.name}  chunk {number}")
            part = scenes.load(number)
            images = render_labelled_images(
                log,
                part.chunk,
                part.scene,
                request.shifts_m,
                every=request.every,
                recorded=request.recorded,
                progress=progress,
                ingest=read_chunk_config(scenes.record, number).ingest,
            )
            for labelled in images:
                yield keep_visible_boxes(labelled, request.min_points)
