"""Ego mask: the recording vehicle's own bonnet or roof, the same in every image while the world passes by."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping

import numpy as np
from numpy.typing import NDArray

from genre_tasks.effects.measurements import IMAGE_STEP_M, ChunkMeasurements
from genre_tasks.effects.types import Effect, EffectParameters, Measurement
from genre_tasks.logs.types import Float32
from genre_tasks.scene.visibility import find_visible_points

STILL_LEVELS = 6.0
"""Standard deviation over the frames, of 255, up to which a pixel does not change."""

# A smooth road stands still too, but blurs into what passes by.
EDGE_LEVELS = 8.0
"""A part is of the vehicle if its outline is an edge of so many levels a pixel in the mean of all frames."""

MOTIONLESS_LEVELS = 1.5
"""Standard deviation over the frames of what does not even mirror the world."""

# Paint of the road's colour has no edge around it, and a black road at night fades into what moves.
CHANGE_RATIO = 4.0
"""A motionless part is of the vehicle if what passes by just outside of it changes so many times as much."""

RIM_PX = 3
"""Width of the rims inside and outside of a part whose changes are compared."""

# The edge of the vehicle is blurred into the road.
MARGIN_PX = 3
"""Masks are enlarged by so many pixels."""

ARC_PX = 4
"""How far an upper outline may be from its arc, a parabola over the image's columns."""

MIN_ARC_COLUMNS = 12
GAP_COLUMNS = 25

STEP_PX = 2
"""From one column to the next an outline goes up or down by at most so many rows."""

MEAN_STEP_PX = 0.3
"""And on average by no more than this: what goes up and down more is the edges of a still road, in few small images."""

# Where the arc is known, a fainter edge along it is evidence enough.
FAINT_LEVELS = EDGE_LEVELS / 2

# A tenth of a decibel is gained outside of the mask (validation streets 900–902, medians: 0.06 dB at 1 %, 0.27 at 2 and
# 4, 0.54 at 8; a bonnet of the road's colour costs next to nothing up to 8 %).
THRESHOLD_PERCENT = 1.2

# Smaller parts are as often road as vehicle.
MIN_MASK_PERCENT = 0.3

MAX_MASK_PERCENT = 60.0
"""No vehicle fills more of an image: what stands still there is the night, a cover, or a picture that is stuck."""

MAX_COLOR_PERCENT = 35.0
"""Larger parts may be a still road in small images, and take no colours away: that would cost more than paint does."""

MIN_TRAVEL_M = 2.0
MIN_FRAMES = 4


def measure(measurements: ChunkMeasurements) -> Measurement:
    """Measures the largest part at the lower edge of a camera's images that never changes.

    Args:
        measurements: the chunk's images over time.

    Returns:
        Percentage of the image's area. No value where the vehicle stands, since then all of the image never changes,
        and none where too few images were taken at different places.
    """
    travel = _travel_m(measurements)
    if travel < MIN_TRAVEL_M:
        return Measurement(None, f"the vehicle travels {travel:.1f} m: all of the image stands still")
    parts = _find_still_parts(measurements)
    if not parts:
        return Measurement(None, _explain_too_few_images(measurements))
    percents = {camera: 100 * float(part.mean()) for camera, part in parts.items()}
    percents_of_vehicle = {camera: percent for camera, percent in percents.items() if percent <= MAX_MASK_PERCENT}
    largest = max(percents_of_vehicle.values(), default=0.0)
    if largest:
        return Measurement(largest, f"of {max(percents_of_vehicle, key=percents_of_vehicle.__getitem__)}")
    stuck = [camera for camera in percents if camera not in percents_of_vehicle]
    if stuck:
        return Measurement(0.0, f"{percents[stuck[0]]:.0f} % of {stuck[0]} stand still, more than a vehicle fills")
    return Measurement(0.0, "no part of an image stands still")


def fit(measurements: ChunkMeasurements) -> EffectParameters:
    """Finds the ego masks that are larger than ``MIN_MASK_PERCENT``, and enlarges them by ``MARGIN_PX``.

    Args:
        measurements: the chunk's images over time.

    Returns:
        A mask for each camera that sees the vehicle; none where the vehicle stands.
    """
    if _travel_m(measurements) < MIN_TRAVEL_M:
        return EffectParameters()
    from scipy import ndimage

    masks = {
        camera: ndimage.binary_dilation(part, iterations=MARGIN_PX)
        for camera, part in _find_still_parts(measurements).items()
        if MIN_MASK_PERCENT < 100 * part.mean() <= MAX_MASK_PERCENT
    }
    return EffectParameters(ego_masks=masks, ego_points=_find_ego_points(measurements, masks))


def _find_ego_points(
    measurements: ChunkMeasurements, masks: Mapping[str, NDArray[np.bool_]]
) -> NDArray[np.int64] | None:
    """The background's points that ``ingest`` coloured by a pixel of the vehicle; ``None`` where there is none."""
    masks = {camera: mask for camera, mask in masks.items() if 100 * mask.mean() <= MAX_COLOR_PERCENT}
    if not masks:
        return None
    chunk = measurements.ingested
    rows = [np.empty(0, np.int64)]
    for view in chunk.views_with_role("source"):
        if view.camera not in masks:
            continue
        index, uv, _ = find_visible_points(chunk.static.positions, view)
        row = uv[:, 1].astype(np.int64)
        column = uv[:, 0].astype(np.int64)
        pixels = measurements.decode_view(view)[row, column]
        # Another camera may have given the point its colour, or the same one from a place that sees it.
        is_source = (pixels == chunk.static.colors[index]).all(1)
        rows.append(index[masks[view.camera][row, column] & is_source])
    found = np.unique(np.concatenate(rows))
    return found if len(found) else None


def _explain_too_few_images(measurements: ChunkMeasurements) -> str:
    image_counts = Counter(view.camera for view in measurements.chunk.views)
    if max(image_counts.values(), default=0) < MIN_FRAMES:
        return f"no camera has {MIN_FRAMES} images"
    return f"no camera has {MIN_FRAMES} images taken {IMAGE_STEP_M} m apart: from one place, road stands still too"


def _travel_m(measurements: ChunkMeasurements) -> float:
    centers = measurements.chunk.chunk_SE3_ego[:, :3, 3]
    return float(np.linalg.norm(centers - centers[:1], axis=1).max())


def _find_still_parts(measurements: ChunkMeasurements) -> dict[str, NDArray[np.bool_]]:
    """By camera, [H, W]; cameras with fewer than ``MIN_FRAMES`` images are left out."""
    parts = {}
    for camera in measurements.chunk.camera_names:
        images = measurements.images_over_time[camera]
        if len(images) >= MIN_FRAMES:
            parts[camera] = find_vehicle(images.astype(np.float32))
    return parts


def find_vehicle(images: Float32) -> NDArray[np.bool_]:
    """Finds the recording vehicle itself in the images of one camera.

    A part is of the vehicle if it reaches the lower edge and does not change, and if either its outline is a still edge
    or what is just outside of it changes far more than what is just inside.

    Args:
        images: [F, H, W, 3] sRGB in 0 to 255, at different times.

    Returns:
        [H, W] true at the vehicle; the largest such part.

    >>> street = np.random.default_rng(0).uniform(90, 200, (8, 40, 60, 3)).astype(np.float32)
    >>> street[:, 30:] = 20.0
    >>> find_vehicle(street)[:, 30].nonzero()[0].tolist() == list(range(30, 40))
    True
    """
    from scipy import ndimage

    # The channel that changes most counts: a change of hue may leave the brightness as it is.
    change = images.std(0).max(-1)
    mean = images.mean(0).mean(-1)
    # Sobel's kernel weighs three rows by 1, 2 and 1: a quarter of it is the height of a step in levels.
    edge = np.hypot(ndimage.sobel(mean, 0), ndimage.sobel(mean, 1)) / 4
    smooth = _find_largest_part((change <= STILL_LEVELS) & (edge < EDGE_LEVELS), edge, _has_edge_around)
    # Paint of the road's colour has no edge, and is found by what moves around it.
    motionless = _find_largest_part(change <= MOTIONLESS_LEVELS, change, _changes_far_less_than_surroundings)
    largest = motionless if motionless.sum() > smooth.sum() else smooth
    return _fill_below_outline(largest, edge) if largest.any() else largest


def _find_largest_part(
    mask: NDArray[np.bool_], levels: Float32, is_vehicle: Callable[[NDArray[np.bool_], Float32], bool]
) -> NDArray[np.bool_]:
    """Finds the largest connected part that reaches the last row and is of the vehicle.

    Args:
        mask: [H, W] true at the parts.
        levels: [H, W] what a part is judged by.
        is_vehicle: judges a part by the levels in and around it, up to ``RIM_PX`` + 1 pixels away.

    Returns:
        [H, W] true at the part; nowhere if there is none.
    """
    from scipy import ndimage

    labels, _ = ndimage.label(mask)
    at_edge = np.unique(labels[-1][labels[-1] > 0])
    sizes = np.bincount(labels.ravel())[at_edge]
    windows = ndimage.find_objects(labels)
    # One part at a time and in its window alone: a noisy lower edge has hundreds of parts.
    for label in at_edge[np.argsort(-sizes, kind="stable")]:
        window = tuple(slice(max(side.start - RIM_PX - 2, 0), side.stop + RIM_PX + 2) for side in windows[label - 1])
        if is_vehicle(labels[window] == label, levels[window]):
            return np.asarray(labels == label)
    return np.zeros(mask.shape, bool)


def _has_edge_around(part: NDArray[np.bool_], edge: Float32) -> bool:
    """Whether the mean of all frames has an edge around the part."""
    from scipy import ndimage

    around = ndimage.binary_dilation(part) & ~part
    return bool(around.any()) and float(np.median(edge[around])) >= EDGE_LEVELS


def _changes_far_less_than_surroundings(part: NDArray[np.bool_], change: Float32) -> bool:
    from scipy import ndimage

    # The pixel next to the part is left out on the outside: it mixes both.
    outside = ndimage.binary_dilation(part, iterations=RIM_PX + 1) & ~ndimage.binary_dilation(part, iterations=1)
    inside = part & ~ndimage.binary_erosion(part, iterations=RIM_PX, border_value=1)
    if not outside.any() or not inside.any():
        return False
    change_inside = max(float(np.median(change[inside])), MOTIONLESS_LEVELS / 4)
    return float(np.median(change[outside])) >= CHANGE_RATIO * change_inside


def _fill_below_outline(part: NDArray[np.bool_], edge: Float32) -> NDArray[np.bool_]:
    """Adds what lies below the upper outline of a part, and below its arc as far as a still edge goes on along it.

    Paint mirrors what passes by, and an antenna cuts it in two: the part itself is but a piece of the vehicle.
    """
    from scipy import ndimage

    rows = np.arange(len(part))[:, None]
    columns = np.arange(part.shape[1])
    below_part = part.cumsum(0) > 0
    part_columns = np.flatnonzero(part.any(0))
    tops = part.argmax(0)[part_columns]
    # The part ends a pixel or two beside the edge, whose position the mean of all frames blurs.
    strongest_edge = ndimage.maximum_filter1d(edge, 2 * ARC_PX + 1, axis=0)
    on_edge = strongest_edge[tops, part_columns] >= EDGE_LEVELS
    if on_edge.sum() < MIN_ARC_COLUMNS:
        return part | below_part
    arc = np.zeros(3)
    on_arc = on_edge
    # Three rounds of fitting and leaving out what is far from the arc: an antenna's top is an outlier.
    for _ in range(3):
        arc = np.polyfit(part_columns[on_arc], tops[on_arc], 2)
        on_arc = on_edge & (np.abs(np.polyval(arc, part_columns) - tops) <= ARC_PX)
        if on_arc.sum() < MIN_ARC_COLUMNS:
            return part | below_part
    arc_rows = np.polyval(arc, columns)
    edge_on_arc = np.where(np.abs(rows - arc_rows) <= ARC_PX, edge, 0).max(0) >= FAINT_LEVELS
    arc_columns = part_columns[on_arc]
    middle = int(arc_columns[len(arc_columns) // 2])
    vehicle_columns = _connected_columns(edge_on_arc, middle)
    below_arc = vehicle_columns & (rows >= arc_rows)
    # Where the outline leaves the arc, as a boot's does beside mirrored cars, its edge still leads on.
    outline = _follow_edge(edge, middle, int(tops[part_columns == middle][0]))
    # The edge is one pixel wide to either side of the step, and what is above the vehicle is not of it.
    return below_part | below_arc | (rows > outline)


def _follow_edge(edge: Float32, column: int, row: int) -> NDArray[np.int64]:
    """Follows an edge to both sides, over gaps of up to ``GAP_COLUMNS``.

    Args:
        edge: [H, W] levels a pixel.
        column: where it begins.
        row: there, within ``ARC_PX`` of the edge.

    Returns:
        [W] rows; H where the edge has ended, and everywhere if it is no smooth outline.
    """
    height, width = edge.shape
    outline = np.full(width, height)
    first = max(row - ARC_PX, 0)
    first += int(edge[first : row + ARC_PX + 1, column].argmax())
    for columns in (range(column, width), range(column, -1, -1)):
        at = first
        last_seen = 0
        followed: list[int] = []
        for x in columns:
            top = max(at - STEP_PX, 0)
            near = edge[top : at + STEP_PX + 1, x]
            if near.max() >= EDGE_LEVELS:
                at = top + int(near.argmax())
                last_seen = len(followed) + 1
            elif len(followed) - last_seen >= GAP_COLUMNS:
                break
            # A gap is filled at the row of its beginning.
            followed.append(at)
        # A gap that nothing follows is the end.
        outline[list(columns)[:last_seen]] = followed[:last_seen]
    rows = outline[outline < height]
    if len(rows) > 1 and np.abs(np.diff(rows)).mean() > MEAN_STEP_PX:
        return np.full(width, height)
    return outline


def _connected_columns(edge_on_arc: NDArray[np.bool_], start: int) -> NDArray[np.bool_]:
    """The columns to both sides of ``start`` up to the first gap of more than ``GAP_COLUMNS``."""
    from scipy import ndimage

    padded = np.pad(edge_on_arc, GAP_COLUMNS, mode="edge")
    bridged = ndimage.binary_closing(padded, np.ones(GAP_COLUMNS))[GAP_COLUMNS:-GAP_COLUMNS]
    labels, _ = ndimage.label(bridged | edge_on_arc)
    return labels == labels[start] if labels[start] else np.zeros_like(edge_on_arc)


EFFECT = Effect(
    name="ego_mask",
    property="part of an image that never changes",
    unit="%",
    threshold=THRESHOLD_PERCENT,
    cost="a mask a camera",
    measure=measure,
    fit=fit,
)
