"""Agreement over shift: what a detector finds on renders of a street and on its true images, at 0 to 5 m."""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Mapping, Sequence
from statistics import mean

import numpy as np
import torch

from benchmarks.common.bench import NotMeasuredError, Row
from benchmarks.common.claims import Claim, claim
from benchmarks.common.run_stages import print_progress
from benchmarks.perception.scenes import METHOD, PerceptionCase, drop_missing, list_detectors, read_scene
from flows.paper_tables.builtin_methods import BUILT_IN
from flows.perception.camera_transfer import DetectionPairs, agreement_metrics
from flows.pipeline.log_cache import cached_log
from genre_tasks.config import RangeConfig
from genre_tasks.detection.coco_classes import find_road_users
from genre_tasks.detection.detector import open_detector
from genre_tasks.metrics.scoring import truth_image
from genre_tasks.reliability.reliable_range import estimate_reliable_range
from genre_tasks.render import RenderSettings
from genre_tasks.scene.chunk import Chunk
from genre_tasks.scene.graph import SceneGraph
from genre_tasks.scene.novel_poses import place_novel_views
from genre_tasks.stages.evaluation_renders import render_batches
from storage.codecs.png import to_pixels

SHIFTS_M = (0.0, 1.0, 2.0, 3.0, 4.0, 5.0)
COMPARED = (METHOD, "3dgs")
EVERY_FRAME = 5
"""Every fifth frame: 4 of a chunk, with three cameras on both sides 24 images a shift."""
RANGE_EVERY = 10
_RESAMPLES = 2000


def measure_shifts(case: PerceptionCase, folder: str, detectors: tuple[str, ...]) -> Row:
    """Measures agreement with the truth at every shift.

    Args:
        case: a chunk of a synthetic street.
        folder: that holds the detectors.
        detectors: names of their files.

    Returns:
        ``agreement``: metrics by detector, method and shift.

    Raises:
        NotMeasuredError: the log has no truth, or a detector is missing.
    """
    truth = cached_log(case.log).truth
    if truth is None:
        raise NotMeasuredError("a recorded log has no truth beside its path")
    # Opened once: reading a network takes longer than an image.
    opened = {name: open_detector(str(path)) for name, path in list_detectors(folder, detectors).items()}
    scenes = {method: read_scene(case, method) for method in COMPARED}
    agreement: dict[str, dict[str, Row]] = {name: {method: {} for method in COMPARED} for name in opened}
    for shift in SHIFTS_M:
        # The views are the same for all methods: none of them moves a street's exact poses.
        chunk = scenes[METHOD][0]
        frames = chunk.frames[::EVERY_FRAME]
        views = place_novel_views(chunk, (shift, -shift) if shift else (0.0,), frames)
        # Ray-cast once for all methods and detectors.
        true_images = [truth_image(chunk, truth, view) for view in views]
        found = {name: tuple(detector.detect(image) for image in true_images) for name, detector in opened.items()}
        for method, (method_chunk, scene) in scenes.items():
            images = _render(method_chunk, scene, shift, frames)
            for name, detector in opened.items():
                finds = tuple(detector.detect(image) for image in images)
                pairs = DetectionPairs(found[name], finds, find_road_users(detector.class_names))
                numbers = agreement_metrics([pairs], has_masks=detector.has_masks)
                agreement[name][method][f"{shift:g}"] = drop_missing(numbers)
        print_progress(f"{case.name} {shift:g} m: done")
    return {"kind": "shifts", "log": case.name, "agreement": agreement}


def _render(chunk: Chunk, scene: SceneGraph, shift: float, frames: Sequence[int]) -> list[np.ndarray]:
    """A scene's images of both sides, in the order of the truth's."""
    views = place_novel_views(chunk, (shift, -shift) if shift else (0.0,), frames)
    batches = [images for _, images in render_batches(scene, views, RenderSettings(), None)]
    return list(to_pixels(torch.cat(batches)))


def measure_range(case: PerceptionCase) -> Row:
    """Measures how far the guards call GenRe+'s scene reliable.

    Args:
        case: a chunk of a synthetic street.

    Returns:
        ``left_m`` and ``right_m``.
    """
    chunk, scene = read_scene(case, METHOD)
    found = estimate_reliable_range(RangeConfig(every=RANGE_EVERY), chunk, scene)
    return {"kind": "range", "log": case.name, "left_m": found.left_m, "right_m": found.right_m}


def shift_claims(rows: Sequence[Row]) -> Iterator[Claim]:
    """Claims that agreement falls with shift, and is higher for GenRe+ than for 3DGS at every shift.

    A claim of a difference is about the mean over streets; its spread is the 95 % interval over streets.

    Args:
        rows: see :func:`measure_shifts`.
    """
    streets = f"{len(rows)} streets"
    if not rows:
        yield claim("perception.shift_rises", None, "<=", 0.0, "steps", "not measured")
        for name in ("shift_fall", *(_shift_name(shift) for shift in SHIFTS_M[1:])):
            yield claim(f"perception.{name}", None, ">", 0.0, "difference", "not measured")
    for detector in sorted({name for row in rows for name in row["agreement"]}):
        curve = [mean_number(rows, detector, METHOD, shift, "ap") for shift in SHIFTS_M]
        known = [value for value in curve if value is not None]
        rises = sum(later > earlier for earlier, later in itertools.pairwise(known))
        note = f"{streets}, {detector}: steps from 0 to 5 m at which GenRe+'s box AP rises"
        yield claim("perception.shift_rises", float(rises) if known else None, "<=", 0.0, "steps", note, len(rows))
        # Paired by street, since streets differ more than shifts do.
        falls = [
            curves["0"]["box/ap"] - curves["5"]["box/ap"]
            for curves in (row["agreement"][detector][METHOD] for row in rows)
            if "box/ap" in curves["0"] and "box/ap" in curves["5"]
        ]
        note = f"{streets}, {detector}: GenRe+'s box AP on the path less that at 5 m; spread: 95 % over streets"
        fall = mean(falls) if falls else None
        yield claim("perception.shift_fall", fall, ">", 0.0, "difference", note, len(falls), bootstrap_mean(falls))
        for shift in SHIFTS_M[1:]:
            differences = list_differences(rows, detector, shift, "ap")
            value = mean(differences) if differences else None
            note = f"{streets}, {detector}, {shift:g} m: box AP, GenRe+ less 3DGS; spread: 95 % over streets"
            yield claim(
                f"perception.{_shift_name(shift)}",
                value,
                ">",
                0.0,
                "difference",
                note,
                len(differences),
                bootstrap_mean(differences),
            )


def _shift_name(shift: float) -> str:
    return f"shift_{shift:g}m_ap"


def mean_number(rows: Sequence[Row], detector: str, method: str, shift: float, name: str) -> float | None:
    """Averages a number over streets.

    Args:
        rows: see :func:`measure_shifts`.
        detector: its name.
        method: key of ``BUILT_IN``.
        shift: metres.
        name: ``ap``, ``recall``, ``iou`` or ``iou_all``, of boxes.

    Returns:
        The mean; ``None`` where no street has it.
    """
    cells = [row["agreement"].get(detector, {}).get(method, {}).get(f"{shift:g}", {}) for row in rows]
    values = [cell[f"box/{name}"] for cell in cells if f"box/{name}" in cell]
    return mean(values) if values else None


def list_differences(rows: Sequence[Row], detector: str, shift: float, name: str) -> list[float]:
    """Lists by how much GenRe+ agrees better than 3DGS, street by street.

    Args:
        rows: see :func:`measure_shifts`.
        detector: its name.
        shift: metres.
        name: ``ap``, ``recall``, ``iou`` or ``iou_all``, of boxes.
    """
    out = []
    for row in rows:
        ours, other = (row["agreement"].get(detector, {}).get(m, {}).get(f"{shift:g}", {}) for m in COMPARED)
        if f"box/{name}" in ours and f"box/{name}" in other:
            out.append(ours[f"box/{name}"] - other[f"box/{name}"])
    return out


def bootstrap_mean(values: Sequence[float]) -> tuple[float, float] | None:
    """Gives the 95 % interval of a mean.

    Args:
        values: independent ones.

    Returns:
        Its bounds; ``None`` with fewer than two values.

    >>> bootstrap_mean([1.0])
    >>> low, high = bootstrap_mean([1.0, 2.0, 3.0])
    >>> 1.0 <= low < 2.0 < high <= 3.0
    True
    """
    if len(values) < 2:
        return None
    # The same resamples for every claim.
    random = np.random.default_rng(0)
    means = random.choice(np.asarray(values), (_RESAMPLES, len(values))).mean(1)
    low, high = np.percentile(means, (2.5, 97.5))
    return float(low), float(high)


def agreement_at_range(row: Row, ranges: Mapping[str, Row], detector: str) -> float | None:
    """Reads a detector's box AP off where the guards' range ends, between two shifts on the line.

    Args:
        row: see :func:`measure_shifts`.
        ranges: rows of :func:`measure_range` by log.
        detector: its name.

    Returns:
        The AP; ``None`` where the range was not measured.
    """
    found = ranges.get(row["log"])
    if found is None:
        return None
    curve = row["agreement"][detector][METHOD]
    known = [(shift, curve[f"{shift:g}"]["box/ap"]) for shift in SHIFTS_M if "box/ap" in curve.get(f"{shift:g}", {})]
    # Views of both sides are pooled in the curve, so the range is, too.
    reach = (found["left_m"] + found["right_m"]) / 2
    return float(np.interp(reach, [s for s, _ in known], [v for _, v in known])) if known else None


def shift_table(rows: Sequence[Row]) -> Iterator[str]:
    """Gives the mean agreement over shift, a line for each detector and method.

    Args:
        rows: see :func:`measure_shifts`.
    """
    yield "| detector | method | " + " | ".join(f"AP at {shift:g} m" for shift in SHIFTS_M) + " |"
    yield "|---" * (2 + len(SHIFTS_M)) + "|"
    for detector in sorted({name for row in rows for name in row["agreement"]}):
        for method in COMPARED:
            values = [mean_number(rows, detector, method, shift, "ap") for shift in SHIFTS_M]
            texts = ["–" if value is None else f"{value:.3f}" for value in values]
            yield f"| {detector} | {BUILT_IN[method].name} | {' | '.join(texts)} |"
