"""How hard the loss pulls at each Gaussian on the image, from the gradient that every renderer gives: that of its mean.

Density control (Kerbl et al. 2023, Sec. 5.2) asks for dL/du, u the projected centre; renderers here return dL/dmean. In
camera axes g = R · dL/dmean, and u = f · x/z + c, so that at a fixed footprint g_x = f/z · dL/du_x, that is::

    dL/du = (z / f_x · g_x,  z / f_y · g_y)

Approximate, because g also holds how the footprint changes its shape where the Gaussian moves sideways: the
linearisation depends on x/z. Against the part that is meant it is of the order of the Gaussian's angular size times
x/z: a few per cent for surfaces near the road, and nothing at the image's centre. Depth terms act along z alone and do
not enter. ``tests/per_scene/test_screen_gradient.py`` holds this against the reference renderer.
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from genre_tasks.logs.types import Float64, Lens
from genre_tasks.render.constants import BLUR_PX2, NEAR_M

REACH = 3.0
"""Standard deviations to which a Gaussian counts as seen (gsplat's radius)."""


def screen_pull(
    means: Tensor,  # [N, 3] chunk coordinates at the view's frame
    gradient: Tensor,  # [N, 3] dL/dmean of one view, chunk coordinates
    scale: Tensor,  # [N] metres, the largest of the three
    chunk_SE3_camera: Float64,
    lens: Lens,
) -> tuple[Tensor, Tensor]:
    """‖dL/du‖ [N] with the image from −1 to 1 along both axes (gsplat's convention), and who is in view [N] bool.

    Someone hidden behind others is in view too, as in gsplat: a zero counts in the mean. Elementwise arithmetic alone,
    so that the bits do not depend on threads.
    """
    camera = torch.as_tensor(np.linalg.inv(chunk_SE3_camera)).to(means)
    place, push = means.T.contiguous(), gradient.T.contiguous()
    x, y, z = (_turned(place, camera[k, :3]) + camera[k, 3] for k in range(3))
    near = z >= NEAR_M
    z = torch.where(near, z, 1.0)
    seen, square = near, torch.zeros_like(z)
    for k, along, focal, center, size in (
        (0, x, lens.fx_px, lens.cx_px, lens.width_px),
        (1, y, lens.fy_px, lens.cy_px, lens.height_px),
    ):
        per_metre = focal / z
        at = along * per_metre + center
        radius = REACH * torch.sqrt((per_metre * scale).square() + BLUR_PX2)
        seen = seen & (at + radius > 0) & (at - radius < size)
        square = square + (_turned(push, camera[k, :3]) / per_metre * (size / 2)).square()
    return torch.where(seen, square.sqrt(), 0.0), seen


def _turned(vectors: Tensor, row: Tensor) -> Tensor:
    """[3, N] · [3]; written out, since matrix products split their sums by the number of threads."""
    return vectors[0] * row[0] + vectors[1] * row[1] + vectors[2] * row[2]
