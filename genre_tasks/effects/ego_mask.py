"""Ego mask: the recording vehicle's own bonnet or roof, the same in every image while the world passes by."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from genre_tasks.effects.seen import Seen
from genre_tasks.effects.types import Effect, Measured

STILL_LEVELS = 6.0
"""Standard deviation over the frames, of 255, up to which a pixel does not change."""

EDGE_LEVELS = 8.0
"""A part is the vehicle's own if its outline is an edge of so many levels a pixel in the mean of all frames: a smooth
road stands still too, but blurs into what passes by."""

MIN_TRAVEL_M = 2.0
MIN_FRAMES = 4


def measure(seen: Seen) -> Measured:
    """The area of the largest part at the lower edge of a camera's images that never changes."""
    centres = seen.chunk.chunk_SE3_ego[:, :3, 3]
    travel = float(np.linalg.norm(centres - centres[:1], axis=1).max())
    if travel < MIN_TRAVEL_M:
        return Measured(None, f"the vehicle travels {travel:.1f} m: all of the image stands still")
    shares: dict[str, float] = {}
    for camera in seen.chunk.camera_names:
        views = [v for v in seen.chunk.views if v.camera == camera]
        if len(views) < MIN_FRAMES:
            continue
        images = np.stack([seen.decoded(v) for v in views[:: max(1, len(views) // 10)]]).astype(np.float32)
        shares[camera] = _own_share(images)
    if not shares:
        return Measured(None, f"no camera has {MIN_FRAMES} images")
    name = max(shares, key=lambda n: shares[n])
    return Measured(100 * shares[name], f"of {name}" if shares[name] else "no part of an image stands still")


def _own_share(images: NDArray[np.float32]) -> float:
    """Of [F, H, W, 3] in 0 to 255: the share of the largest still part at the lower edge with a still outline."""
    from scipy import ndimage

    still = (images.std(0) <= STILL_LEVELS).all(-1)
    mean = images.mean(0).mean(-1)
    edge = np.hypot(ndimage.sobel(mean, 0), ndimage.sobel(mean, 1)) / 4
    parts, _ = ndimage.label(still & (edge < EDGE_LEVELS))
    shares = [0.0]
    for part in np.unique(parts[-1][parts[-1] > 0]):
        own = parts == part
        around = ndimage.binary_dilation(own) & ~own
        if around.any() and float(np.median(edge[around])) >= EDGE_LEVELS:
            shares.append(float(own.mean()))
    return max(shares)


EFFECT = Effect("ego_mask", "part of an image that never changes", "%", 0.5, "a mask a camera", measure)
