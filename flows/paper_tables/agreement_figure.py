"""What a detector finds on the recorded images of the front-left camera, and on every method's renders of them."""

from __future__ import annotations

from flows.experiments.stages import StageRunner, run_stages
from flows.paper_tables.agreement_cells import open_cached_detector, render_front_left
from flows.paper_tables.comparison_strips import ComparisonStrip, Pixels
from flows.paper_tables.measure import list_stages
from flows.paper_tables.request import CheckedRequest
from genre_tasks.detection.detector import Detector
from genre_tasks.detection.drawing import draw_detections
from genre_tasks.errors import InputError

MOMENTS = 3
"""Columns of the figure, where no frame is chosen."""


def agreement_strips(checked: CheckedRequest, runner: StageRunner, frame: int | None = None) -> list[ComparisonStrip]:
    """Draws finds on recorded and rendered images, on the request's first chunk.

    Args:
        checked: table 7 with its detector; rows that cannot be measured are left out.
        runner: runs one stage.
        frame: of the log; several moments if ``None``.

    Returns:
        The recorded images, then a row for each method.

    Raises:
        InputError: the camera has no image of this frame.
    """
    # The same detector for all rows, or they would not compare.
    detector = open_cached_detector(str(checked.detector))
    where = checked.places[0]
    strips: list[ComparisonStrip] = []
    for row in checked.measurable_rows:
        job = checked.basis.job(checked.layout, row.method, where)
        refs = run_stages(list_stages(checked.layout, row.method), job, runner)
        images = render_front_left(job, refs, row.method.end)
        frames = [view.frame for view in images.views]
        chosen = _choose_moments(frames, frame)
        captions = tuple(f"{images.views[0].camera}, frame {frames[k]}" for k in chosen)
        # The recorded images are the same for every method.
        if not strips:
            strips.append(
                ComparisonStrip("recorded", tuple(_draw(detector, images.recorded[k]) for k in chosen), captions)
            )
        strips.append(ComparisonStrip(row.label, tuple(_draw(detector, images.rendered[k]) for k in chosen), captions))
    return strips


def _choose_moments(frames: list[int], frame: int | None) -> list[int]:
    """Indices of the images to show."""
    if frame is None:
        last = len(frames) - 1
        return sorted({round(last * k / (MOMENTS - 1)) for k in range(MOMENTS)})
    if frame not in frames:
        raise InputError(
            f"the front-left camera has no image at frame {frame}",
            remedy=f"Choose --frame from {', '.join(map(str, frames))}.",
        )
    return [frames.index(frame)]


def _draw(detector: Detector, image: Pixels) -> Pixels:
    return draw_detections(image, detector.detect(image), detector.class_names)
