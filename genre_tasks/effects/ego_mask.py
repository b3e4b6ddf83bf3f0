"""Ego mask: the recording vehicle's own bonnet or roof, the same in every image while the world passes by."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from genre_tasks.effects.seen import Seen
from genre_tasks.effects.types import Effect, Fitted, Measured

STILL_LEVELS = 6.0
"""Standard deviation over the frames, of 255, up to which a pixel does not change."""

EDGE_LEVELS = 8.0
"""A part is the vehicle's own if its outline is an edge of so many levels a pixel in the mean of all frames: a smooth
road stands still too, but blurs into what passes by."""

MARGIN_PX = 3

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
        views = [v for v in seen.chunk.views if v.camera == camera]
        if len(views) >= MIN_FRAMES:
            images = np.stack([seen.decoded(v) for v in views[:: max(1, len(views) // 10)]]).astype(np.float32)
            found[camera] = _own_part(images)
    return found


def _own_part(images: NDArray[np.float32]) -> NDArray[np.bool_]:
    """Of [F, H, W, 3] in 0 to 255: [H, W], the largest still part at the lower edge with a still outline."""
    from scipy import ndimage

    still = (images.std(0) <= STILL_LEVELS).all(-1)
    mean = images.mean(0).mean(-1)
    edge = np.hypot(ndimage.sobel(mean, 0), ndimage.sobel(mean, 1)) / 4
    parts, _ = ndimage.label(still & (edge < EDGE_LEVELS))
    best = np.zeros_like(still)
    for part in np.unique(parts[-1][parts[-1] > 0]):
        own = parts == part
        around = ndimage.binary_dilation(own) & ~own
        if around.any() and float(np.median(edge[around])) >= EDGE_LEVELS and own.sum() > best.sum():
            best = own
    return best


EFFECT = Effect("ego_mask", "part of an image that never changes", "%", 0.5, "a mask a camera", measure, fit=fit)
