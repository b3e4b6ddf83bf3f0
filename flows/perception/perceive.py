"""A detector on a finished run: what it finds in recorded and in rendered images, as files and as numbers."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from flows.perception.detections_table import DetectionsTable
from flows.perception.perceived_images import ImageSource, PerceivedImage, perceive_views, select_views
from flows.perception.perception_sheet import draw_sheet
from flows.simulation.run_scenes import RunScenes
from genre_tasks.atomic_path import atomic_path
from genre_tasks.detection.agreement import Agreement, ImageMatches, match_image, summarise_matches
from genre_tasks.detection.coco_classes import find_road_users
from genre_tasks.detection.detections import Detections
from genre_tasks.detection.detector import Detector
from genre_tasks.progress import Progress, silent
from storage.codecs.png import write_png

TABLE_NAME = "detections.parquet"
PICTURE_NAME = "perception.png"


@dataclass(frozen=True)
class PerceiveRequest:
    """What a detector is run on.

    Attributes:
        store: folder (or URI) of the store.
        run: the run's name, or the start of it.
        out: folder for the files.
        chunk: number of the chunk; ``None`` for the run's first one.
        stage: initial, gnet or enet; ``None`` for the chunk's last one.
        shifts_m: metres to the left; each at most once.
        cameras: names; ``None`` for all.
        every: every n-th frame is taken.
    """

    store: str
    run: str
    out: Path
    chunk: int | None = None
    stage: str | None = None
    shifts_m: tuple[float, ...] = (0.0,)
    cameras: tuple[str, ...] | None = None
    every: int = 1


@dataclass(frozen=True)
class FindCount:
    """How much a detector finds in images of one kind.

    Attributes:
        source: recorded or rendered.
        shift_m: metres to the left of the path.
        images: number of images.
        finds: detections of the counted classes in them.
    """

    source: ImageSource
    shift_m: float
    images: int
    finds: int


@dataclass(frozen=True)
class Perception:
    """What a detector finds in a chunk.

    Attributes:
        log: name of the log.
        chunk: number of the chunk.
        stage: whose scene was rendered.
        counted: names of the classes that are counted: the detector's road users, or all classes where it has none.
        counts: of the recorded images, and of the renders at each shift.
        boxes: agreement of boxes between recorded images and renders on the path; ``None`` without shift 0, and of a
            run with edited traffic.
        masks: agreement of masks; ``None`` where that of boxes is, and from detectors without masks.
        files: paths of the files.
        no_agreement: why renders on the path are not compared, although there are some; empty otherwise.
    """

    log: str
    chunk: int
    stage: str
    counted: tuple[str, ...]
    counts: tuple[FindCount, ...]
    boxes: Agreement | None
    masks: Agreement | None
    files: tuple[str, ...]
    no_agreement: str = ""


def perceive_run(request: PerceiveRequest, detector: Detector, progress: Progress = silent) -> Perception:
    """Runs a detector on a chunk of a finished run, and writes what it finds.

    Args:
        request: what it is run on.
        detector: any.
        progress: called with the images done and their total.

    Returns:
        The counts, the agreement and the files.

    Raises:
        InputError: there is no such run, chunk, stage or camera, or an image cannot be decoded.
        ArtifactCorruptError: an artifact is damaged.
        OSError: the folder cannot be written.
    """
    scenes = RunScenes(request.store, request.run, request.stage, None if request.chunk is None else [request.chunk])
    number = scenes.chunk_numbers[0]
    part = scenes.load(number)
    views = select_views(part.chunk, request.cameras, request.every)
    frames = sorted({view.frame for view in views})
    edited = scenes.record.get("edited")
    has_path = 0.0 in request.shifts_m
    findings = _Findings(detector, frames[len(frames) // 2], has_path=has_path and edited is None)
    for perceived in perceive_views(part.chunk, part.scene, views, request.shifts_m, detector, progress):
        findings.add(perceived)
    # Read from the run, since the request may leave it open.
    stage = scenes.find_stage(number)
    facts = {"log": part.chunk.log, "chunk": str(number), "stage": stage, "run": str(scenes.record["run"])}
    files = findings.write(request.out, facts)
    counted = tuple(detector.class_names[label] for label in findings.counted)
    boxes = summarise_matches(findings.box_matches) if findings.box_matches else None
    masks = summarise_matches(findings.mask_matches) if findings.mask_matches else None
    no_agreement = ""
    if has_path and edited is not None:
        # A detector that sees the edits would count as wrong.
        no_agreement = f"its traffic is edited, and the recorded images show that of the run {edited['run']}"
    return Perception(
        log=part.chunk.log,
        chunk=number,
        stage=stage,
        counted=counted,
        counts=findings.list_counts(),
        boxes=boxes,
        masks=masks,
        files=files,
        no_agreement=no_agreement,
    )


@dataclass
class _Findings:
    """What was found so far: rows of the table, counts, matches, and the images that are shown.

    Attributes:
        detector: whose finds they are.
        shown_frame: the frame whose images the picture has.
        has_path: whether there are renders on the path that are compared with the recorded images.
    """

    detector: Detector
    shown_frame: int
    has_path: bool
    box_matches: list[ImageMatches] = field(default_factory=list)
    mask_matches: list[ImageMatches] = field(default_factory=list)

    def __post_init__(self) -> None:
        names = self.detector.class_names
        # A detector of traffic signs, say, is compared by all that it finds.
        self.counted = find_road_users(names) or tuple(range(len(names)))
        self._table = DetectionsTable(names)
        self._shown: list[PerceivedImage] = []
        self._images: Counter[tuple[ImageSource, float]] = Counter()
        self._finds: Counter[tuple[ImageSource, float]] = Counter()
        self._recorded: dict[tuple[str, int], Detections] = {}

    def add(self, perceived: PerceivedImage) -> None:
        """Adds an image; a recorded one comes before its renders."""
        self._table.add(perceived)
        kind = (perceived.source, perceived.shift_m)
        self._images[kind] += 1
        self._finds[kind] += int(np.isin(perceived.detections.classes, self.counted).sum())
        # The pixels of one frame alone are kept.
        if perceived.frame == self.shown_frame:
            self._shown.append(perceived)
        if not self.has_path:
            return
        place = (perceived.camera, perceived.frame)
        if perceived.source == "recorded":
            self._recorded[place] = perceived.detections
        elif perceived.shift_m == 0:
            # Taken out, because masks of all images would not fit into memory.
            self._match(self._recorded.pop(place), perceived.detections)

    def _match(self, recorded: Detections, rendered: Detections) -> None:
        self.box_matches.append(match_image(recorded, rendered, self.counted))
        # Masks as well, because they tell shapes apart that share a rectangle.
        if self.detector.has_masks:
            self.mask_matches.append(match_image(recorded, rendered, self.counted, of_masks=True))

    def list_counts(self) -> tuple[FindCount, ...]:
        """The counts, recorded images first."""
        return tuple(FindCount(*kind, images, self._finds[kind]) for kind, images in self._images.items())

    def write(self, folder: Path, facts: dict[str, str]) -> tuple[str, ...]:
        """Writes the table and the picture, and gives their paths."""
        # Made only now: a run that fails leaves no empty folder.
        folder.mkdir(parents=True, exist_ok=True)
        table = folder / TABLE_NAME
        self._table.write(table, facts)
        picture = folder / PICTURE_NAME
        with atomic_path(picture) as part:
            write_png(part, draw_sheet(self._shown, self.detector.class_names))
        return str(table), str(picture)


def tabulate_perception(perception: Perception) -> list[dict[str, str]]:
    """Tabulates what a detector finds, for the terminal.

    Args:
        perception: of a chunk.

    Returns:
        A row for the recorded images and for each shift; agreement stands in the row of renders on the path.
    """
    rows = []
    for count in perception.counts:
        on_path = count.source == "rendered" and count.shift_m == 0
        row = {
            "source": count.source,
            "shift": f"{count.shift_m:+g} m" if count.source == "rendered" else "",
            "images": str(count.images),
            "finds": str(count.finds),
            "an image": f"{count.finds / count.images:.1f}",
            **_agreement_cells(perception.boxes if on_path else None, "box"),
        }
        if perception.masks is not None:
            row |= _agreement_cells(perception.masks if on_path else None, "mask")
        rows.append(row)
    return rows


def _agreement_cells(agreement: Agreement | None, kind: str) -> dict[str, str]:
    """Average precision, recall and overlap; empty where there are none."""
    numbers: Sequence[tuple[str, float]] = (
        (f"{kind} AP", math.nan if agreement is None else agreement.average_precision),
        (f"{kind} recall", math.nan if agreement is None else agreement.recall),
        (f"{kind} IoU", math.nan if agreement is None else agreement.matched_overlap),
    )
    return {name: "" if math.isnan(value) else f"{value:.2f}" for name, value in numbers}
