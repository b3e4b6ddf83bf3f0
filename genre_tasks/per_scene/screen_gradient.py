"""The gradient of the loss with respect to where a Gaussian is on the image, for density control.

Density control (Kerbl et al. 2023, Sec. 5.2) asks for dL/du, with u the projected centre. Renderers here return
dL/dmean instead. In camera axes g = R · dL/dmean, and u = f · x/z + c, so that at a fixed footprint
g_x = f/z · dL/du_x, and therefore::

    dL/du = (z / f_x · g_x,  z / f_y · g_y)

This is approximate, because g also holds how the footprint changes its shape where the Gaussian moves sideways: the
linearisation depends on x/z. The error is of the order of the Gaussian's angular size times x/z: a few per cent for
surfaces near the road, and nothing at the image's centre. Depth terms act along z alone and do not enter.
``tests/per_scene/test_screen_gradient.py`` holds this against the reference renderer.
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from genre_tasks.logs.types import Float64, Lens
from genre_tasks.render.constants import BLUR_PX2, NEAR_M

REACH = 3.0
"""Standard deviations up to which a Gaussian counts as visible, as in gsplat's radius."""


def screen_space_gradient(
    means: Tensor,  # [N, 3] chunk coordinates at the view's frame
    gradient: Tensor,  # [N, 3] dL/dmean of one view, chunk coordinates
    scale: Tensor,  # [N] metres
    chunk_SE3_camera: Float64,  # [4, 4]
    lens: Lens,
) -> tuple[Tensor, Tensor]:
    """Converts gradients of means into gradients of image positions, and tells which Gaussians are in view.

    Occluded Gaussians count as visible with gradient 0, as in gsplat.

    Args:
        means: centres of the Gaussians.
        gradient: the loss's gradient with respect to them.
        scale: the largest of each Gaussian's three scales.
        chunk_SE3_camera: pose of the camera.
        lens: its lens; distortion is left out.

    Returns:
        ‖dL/du‖ [N] with the image from −1 to 1 along both axes (gsplat's convention), 0 where a Gaussian is not in
        view; and which ones are in view [N], bool. The bits do not depend on the number of threads.
    """
    camera_SE3_chunk = torch.as_tensor(np.linalg.inv(chunk_SE3_camera)).to(means)
    positions = means.T.contiguous()
    gradients = gradient.T.contiguous()
    x, y, z = (_dot(positions, camera_SE3_chunk[k, :3]) + camera_SE3_chunk[k, 3] for k in range(3))
    visible = z >= NEAR_M
    # Nothing is divided by the depth of what is at the camera or behind it.
    z = torch.where(visible, z, 1.0)
    squared_norm = torch.zeros_like(z)
    for axis, coordinate, focal_px, center_px, size_px in (
        (0, x, lens.fx_px, lens.cx_px, lens.width_px),
        (1, y, lens.fy_px, lens.cy_px, lens.height_px),
    ):
        px_per_metre = focal_px / z
        position_px = coordinate * px_per_metre + center_px
        radius_px = REACH * torch.sqrt((px_per_metre * scale).square() + BLUR_PX2)
        visible = visible & (position_px + radius_px > 0) & (position_px - radius_px < size_px)
        # Half the image's size turns a gradient per pixel into one per unit of an image from −1 to 1.
        by_position = _dot(gradients, camera_SE3_chunk[axis, :3]) / px_per_metre * (size_px / 2)
        squared_norm = squared_norm + by_position.square()
    return torch.where(visible, squared_norm.sqrt(), 0.0), visible


def _dot(vectors: Tensor, row: Tensor) -> Tensor:
    """[3, N] · [3] → [N]."""
    # Written out, since a matrix product splits its sums by the number of threads and so changes the last bits.
    return vectors[0] * row[0] + vectors[1] * row[1] + vectors[2] * row[2]
