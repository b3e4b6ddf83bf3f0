"""Ego mask: the recording vehicle's own bonnet or roof, the same in every image while the world passes by."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from genre_tasks.effects.measurements import Seen
from genre_tasks.effects.types import Effect, Fitted, Measured
from genre_tasks.logs.types import Float32

STILL_LEVELS = 6.0
"""Standard deviation over the frames, of 255, up to which a pixel does not change."""

EDGE_LEVELS = 8.0
"""A part is the vehicle's own if its outline is an edge of so many levels a pixel in the mean of all frames: a smooth
road stands still too, but blurs into what passes by."""

MOTIONLESS_LEVELS = 1.5
"""Standard deviation over the frames of what does not even mirror the world."""

STEP = 4.0
"""A motionless part is the vehicle's own if what passes by just outside of it changes so many times as much: paint of
the road's colour has no edge, and a black road at night fades into what moves."""

STEP_PX = 3
MARGIN_PX = 3
ARC_PX = 4
"""How far an upper outline may be from its arc, a parabola over the image's columns."""

MIN_ARC_COLUMNS, GAP_COLUMNS = 12, 25
FAINT_LEVELS = EDGE_LEVELS / 2
"""Where the arc is known a fainter edge along it will do."""

THRESHOLD_PERCENT = 1.2
"""A tenth of a decibel is gained outside of it (validation streets 900–902, medians: 0.06 dB at 1 %, 0.27 at 2 and 4,
0.54 at 8; a bonnet of the road's colour costs next to nothing up to 8 %)."""

LEAST_PERCENT = 0.3
"""Smaller parts are as often road as vehicle."""

MIN_TRAVEL_M = 2.0
MIN_FRAMES = 4


def measure(seen: Seen) -> Measured:
    """The area of the largest part at the lower edge of a camera's images that never changes."""
    travel = _travel(seen)
    if travel < MIN_TRAVEL_M:
        return Measured(None, f"the vehicle travels {travel:.1f} m: all of the image stands still")
    parts = _parts(seen)
    if not parts:
        return Measured(None, f"no camera has {MIN_FRAMES} images")
    shares = {camera: float(part.mean()) for camera, part in parts.items()}
    name = max(shares, key=lambda n: shares[n])
    return Measured(100 * shares[name], f"of {name}" if shares[name] else "no part of an image stands still")


def fit(seen: Seen) -> Fitted:
    """The parts above ``LEAST_PERCENT``, grown by ``MARGIN_PX``: an edge is blurred into the road."""
    if _travel(seen) < MIN_TRAVEL_M:
        return Fitted()
    from scipy import ndimage

    called = {c: p for c, p in _parts(seen).items() if 100 * p.mean() > LEAST_PERCENT}
    own = {c: ndimage.binary_dilation(p, iterations=MARGIN_PX) for c, p in called.items()}
    return Fitted(own=own)


def _travel(seen: Seen) -> float:
    centres = seen.chunk.chunk_SE3_ego[:, :3, 3]
    return float(np.linalg.norm(centres - centres[:1], axis=1).max())


def _parts(seen: Seen) -> dict[str, NDArray[np.bool_]]:
    """By camera, [H, W]."""
    found = {}
    for camera in seen.chunk.camera_names:
        if len(seen.over_time[camera]) >= MIN_FRAMES:
            found[camera] = _own_part(seen.over_time[camera].astype(np.float32))
    return found


def _own_part(images: NDArray[np.float32]) -> NDArray[np.bool_]:
    """Of [F, H, W, 3] in 0 to 255: [H, W], the largest still part at the lower edge with a still outline."""
    from scipy import ndimage

    change = images.std(0).max(-1)
    mean = images.mean(0).mean(-1)
    edge = np.hypot(ndimage.sobel(mean, 0), ndimage.sobel(mean, 1)) / 4
    smooth = _at_lower_edge((change <= STILL_LEVELS) & (edge < EDGE_LEVELS))
    found = [p for p in smooth if _outlined(p, edge)]
    found += [p for p in _at_lower_edge(change <= MOTIONLESS_LEVELS) if _stands_out(p, change)]
    best = max(found, key=lambda p: int(p.sum()), default=np.zeros(change.shape, bool))
    return _below_outline(best, edge) if best.any() else best


def _at_lower_edge(where: NDArray[np.bool_]) -> list[NDArray[np.bool_]]:
    """Connected parts that reach the last row."""
    from scipy import ndimage

    parts, _ = ndimage.label(where)
    return [parts == part for part in np.unique(parts[-1][parts[-1] > 0])]


def _outlined(part: NDArray[np.bool_], edge: Float32) -> bool:
    """Whether the mean of all frames has an edge around the part."""
    from scipy import ndimage

    around = ndimage.binary_dilation(part) & ~part
    return bool(around.any()) and float(np.median(edge[around])) >= EDGE_LEVELS


def _stands_out(part: NDArray[np.bool_], change: Float32) -> bool:
    """Whether what is just outside of the part changes far more than what is just inside."""
    from scipy import ndimage

    wide, narrow = (ndimage.binary_dilation(part, iterations=k) for k in (STEP_PX + 1, 1))
    outside, inside = wide & ~narrow, part & ~ndimage.binary_erosion(part, iterations=STEP_PX, border_value=1)
    if not outside.any() or not inside.any():
        return False
    return float(np.median(change[outside])) >= STEP * max(float(np.median(change[inside])), MOTIONLESS_LEVELS / 4)


def _below_outline(part: NDArray[np.bool_], edge: Float32) -> NDArray[np.bool_]:
    """What lies below the part's upper outline, and below that outline's arc as far as a still edge goes on along it.

    Paint mirrors what passes by, and an antenna cuts it in two: the part itself is but a piece of the vehicle.
    """
    from scipy import ndimage

    rows, columns = np.arange(len(part))[:, None], np.arange(part.shape[1])
    found = np.flatnonzero(part.any(0))
    tops = part.argmax(0)[found]
    near = ndimage.maximum_filter1d(edge, 2 * ARC_PX + 1, axis=0)
    on_edge = near[tops, found] >= EDGE_LEVELS
    if on_edge.sum() < MIN_ARC_COLUMNS:
        return part | (part.cumsum(0) > 0)
    arc, kept = np.zeros(3), on_edge
    for _ in range(3):
        arc = np.polyfit(found[kept], tops[kept], 2)
        kept = on_edge & (np.abs(np.polyval(arc, found) - tops) <= ARC_PX)
        if kept.sum() < MIN_ARC_COLUMNS:
            return part | (part.cumsum(0) > 0)
    top = np.polyval(arc, columns)
    along = np.where(np.abs(rows - top) <= ARC_PX, edge, 0).max(0) >= FAINT_LEVELS
    reach = found[kept]
    goes_on = _run(along, int(reach[len(reach) // 2]))
    return (part.cumsum(0) > 0) | (goes_on & (rows >= top))


def _run(along: NDArray[np.bool_], start: int) -> NDArray[np.bool_]:
    """The columns to both sides of ``start`` up to the first gap of more than ``GAP_COLUMNS``."""
    from scipy import ndimage

    padded = np.pad(along, GAP_COLUMNS, mode="edge")
    bridged = ndimage.binary_closing(padded, np.ones(GAP_COLUMNS))[GAP_COLUMNS:-GAP_COLUMNS]
    labels, _ = ndimage.label(bridged | along)
    return labels == labels[start] if labels[start] else along & False


EFFECT = Effect(
    "ego_mask", "part of an image that never changes", "%", THRESHOLD_PERCENT, "a mask a camera", measure, fit=fit
)
