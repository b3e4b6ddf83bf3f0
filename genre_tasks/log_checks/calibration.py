"""Whether LiDAR and images agree: a wrong camera pose, lens, image or time makes their edges disagree."""

from __future__ import annotations

from collections.abc import Iterator

from genre_tasks.log_checks.camera_view import FEW_IMAGES, score_edges, view_camera
from genre_tasks.log_checks.edge_agreement import Agreement
from genre_tasks.log_checks.image_order import find_image_order
from genre_tasks.log_checks.log_sample import LogSample
from genre_tasks.log_checks.miscalibration_causes import explain_by_turn, list_explanations
from genre_tasks.logs.findings import Finding, Severity
from genre_tasks.logs.types import Camera

# Scores grow with the root of the number of images: a camera with a low one is compared again by more of them.
_MORE_IMAGES = 8
# From the synthetic streets 900 to 939, chunk 0 of the real sequence and KITTI: see the benchmark ``log_faults``.
_MIN_SCORE = 5.0
_MIN_MARGIN = 2.0
_CHANCE_SCORE = 3.5
# A small turn is worth a note where the edges are this clear about it.
_CLEAR_SCORE = 8.0
_CLEAR_MARGIN = 4.0
# In reversed or shifted order, images of streets mostly score 2 to 6: a higher bound costs time in every sound log.
_ORDERED_SCORE = 6.0
# Cameras whose cause is searched for by all means: where more are wrong, they mostly have one cause.
_EXPLAINED_CAMERAS = 2


def find_miscalibration(sample: LogSample) -> Iterator[Finding]:
    """Finds cameras whose images do not show what the LiDAR measures.

    Args:
        sample: the frames of a chunk.

    Yields:
        For each camera at most one of ``turned_camera``, ``odd_field_of_view``, ``intrinsics_of_another_size``,
        ``rolled_camera``, ``flipped_images``, ``images_of_another_camera``, ``images_of_another_frame``,
        ``images_out_of_order`` and ``lidar_image_mismatch``. Images or sweeps without enough edges give no verdict.
        A turn within the accuracy of good calibrations is a note, and only where the edges are clear about it.
    """
    found = 0
    for camera in sample.cameras:
        view = view_camera(sample, camera, FEW_IMAGES)
        agreement = None if view is None else score_edges(view.range_edges, view.image_edges)
        finding = None
        if agreement is not None and not _is_sound(agreement):
            finding = _explain(sample, camera, in_full=found < _EXPLAINED_CAMERAS)
        # Images of other frames agree a little, since roads look alike from one end to the other.
        if (finding is None and not _is_ordered(agreement)) or _is_unexplained(finding):
            finding = find_image_order(sample, camera, view) or finding
        if finding is not None:
            found += 1
            yield finding


def measure_agreement(sample: LogSample, camera: Camera, images: int = FEW_IMAGES) -> Agreement | None:
    """Measures how well the edges of a camera's images agree with those of the LiDAR.

    Args:
        sample: the frames of a chunk.
        camera: one of its cameras.
        images: how many are compared at most.

    Returns:
        The scores; ``None`` where images or sweeps do not have enough edges.
    """
    view = view_camera(sample, camera, images)
    return None if view is None else score_edges(view.range_edges, view.image_edges)


def _is_sound(agreement: Agreement) -> bool:
    score = agreement.near.score
    others = max(agreement.far.score, agreement.best_stretch)
    return score >= _MIN_SCORE and others < score + _MIN_MARGIN and not _is_clearly_turned(agreement)


def _is_ordered(agreement: Agreement | None) -> bool:
    """Whether edges agree so well that the images cannot be those of other frames."""
    return agreement is not None and agreement.near.score >= _ORDERED_SCORE


def _is_unexplained(finding: Finding | None) -> bool:
    return finding is not None and finding.word == "lidar_image_mismatch"


def _is_clearly_turned(agreement: Agreement) -> bool:
    """A turn that is small and beyond doubt."""
    return agreement.near.score >= max(_CLEAR_SCORE, agreement.score + _CLEAR_MARGIN)


def _explain(sample: LogSample, camera: Camera, in_full: bool) -> Finding | None:
    """What makes the edges agree; a finding without a cause where nothing does; ``None`` where nothing can be said."""
    view = view_camera(sample, camera, _MORE_IMAGES)
    agreement = None if view is None else score_edges(view.range_edges, view.image_edges)
    if view is None or agreement is None or _is_sound(agreement):
        return None
    name = camera.name
    frames = tuple(view.image_edges)
    # Within the accuracy of calibrations: a camera that is a little off is no camera with mirrored images.
    score = agreement.near.score
    numbers = {"score": agreement.score, "min_score": _MIN_SCORE, "min_margin": _MIN_MARGIN}
    explanations = [explain_by_turn(agreement.far)]
    if in_full:
        explanations += list_explanations(sample, view, agreement)
    best = max(explanations, key=lambda explanation: explanation.score)
    is_explained = best.score >= max(_MIN_SCORE, score + _MIN_MARGIN)
    if is_explained or _is_clearly_turned(agreement):
        cause = best if is_explained else explain_by_turn(agreement.near)
        message = (
            f"{name}: edges of LiDAR and images agree poorly ({agreement.score:.1f} standard deviations above "
            f"chance) and better ({cause.score:.1f}) {cause.cause}"
        )
        numbers |= {"best_score": cause.score, **cause.numbers}
        severity: Severity = "warning" if is_explained else "note"
        return Finding(cause.word, severity, message, cause.remedy, numbers, name, frames)
    if score < _CHANCE_SCORE:
        message = f"{name}: edges of LiDAR and images agree no better than chance ({score:.1f})"
        remedy = "Check poses, calibration, and that images and sweeps are of the same frames."
        return Finding("lidar_image_mismatch", "warning", message, remedy, numbers, name, frames)
    return None
