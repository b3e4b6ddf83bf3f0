"""What a render costs, counted: how much of the vector units' work changes a pixel."""

from __future__ import annotations

import ctypes
from dataclasses import dataclass

from genre_tasks.render.cpu import check_status, run_forward
from genre_tasks.render.kernel.library import load_kernel
from genre_tasks.render.types import Cameras
from genre_tasks.scene.gaussians import Splats

FLOP_PER_LANE_FORWARD = 31
"""log2 α 8, 2^x 13, w and T 2, colour and depth 8. A multiply-add counts two; comparisons, masks, integer operations
and what is done once a footprint (finding its blocks) are not counted."""

FLOP_PER_LANE_BACKWARD = 60
"""α again 21, w and T 2, dL/dw 9, dL/dα 7, s and dy again 2, ten sums 19; once a footprint (folding the sums): not."""


@dataclass(frozen=True)
class Work:
    """Counts of a forward pass of the CPU kernel, summed over views; its backward pass visits the same lanes."""

    drawn: int
    """Gaussians with a footprint on the image."""
    tile_pairs: int
    """(tile, footprint) pairs."""
    lanes: int
    """Pixels of (block, footprint) pairs that were computed, idle lanes among them."""
    contributions: int
    """(pixel, Gaussian) pairs that were blended."""


def count_work(splats: Splats, cameras: Cameras) -> Work:
    """Renders once and counts what the CPU kernel did.

    Args:
        splats: N Gaussians.
        cameras: V views.

    Returns:
        Work: summed over the views.

    Raises:
        ValueError: as :func:`genre_tasks.render.render`.
    """
    state = run_forward(splats, cameras)
    counts = (ctypes.c_longlong * 4)()
    # The kernel's own bookkeeping is read, because a second count in Python could differ from what it does.
    check_status(load_kernel().genre_work(state.handle, counts))
    return Work(*counts)
