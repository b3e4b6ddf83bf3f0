"""The ``cuda`` backend: gsplat behind the same function (optional)."""

from __future__ import annotations

import torch
from torch import Tensor

from genre_tasks.errors import ResourceError
from genre_tasks.render import constants as const
from genre_tasks.render.types import Cameras
from genre_tasks.scene.gaussians import Splats


def render_cuda(splats: Splats, cameras: Cameras) -> tuple[tuple[Tensor, Tensor, Tensor], dict[str, int]]:
    """Colour [V, H, W, 3], alpha and depth [V, H, W], float32, on the splats' device, and the culled counts.

    gsplat clamps alpha at 0.999 where this project's other backends clamp at 0.99, and takes the plain determinant of
    the projected covariance: images differ where layers are nearly opaque (up to 0.009 of a layer's colour).

    Raises:
        ResourceError: gsplat or a GPU is missing.
    """
    try:
        from gsplat import rasterization
    except ImportError as error:
        raise ResourceError(
            "the cuda backend needs gsplat, which is not installed", remedy="Run `pip install -e '.[cuda]'` or use cpu"
        ) from error
    if not torch.cuda.is_available():
        raise ResourceError("the cuda backend found no GPU", remedy="Use backend cpu")
    if splats.means.device.type != "cuda":
        raise ResourceError("the cuda backend got tensors on the CPU", remedy="Move the splats to the GPU, or use cpu")
    safe, culled = _without_unsound(splats, len(cameras))
    like = safe.means
    intrinsics = torch.zeros(len(cameras), 3, 3, device=like.device)
    intrinsics[:, 0, 0], intrinsics[:, 1, 1] = cameras.focal_px.to(like).unbind(1)
    intrinsics[:, :2, 2], intrinsics[:, 2, 2] = cameras.center_px.to(like), 1.0
    image, alpha, _ = rasterization(
        safe.means, safe.quats, safe.scales, safe.opacities, safe.colors, cameras.camera_SE3_chunk.to(like), intrinsics,
        cameras.width_px, cameras.height_px, near_plane=const.NEAR_M, eps2d=const.BLUR_PX2, render_mode="RGB+D",
        packed=False,
    )  # fmt: skip
    # "D" is the accumulated Σ w z; "ED" would be divided by alpha.
    return (image[..., :3], alpha[..., 0], image[..., 3]), culled


def _without_unsound(splats: Splats, views: int) -> tuple[Splats, dict[str, int]]:
    """Float32 splats in which unsound Gaussians are harmless, transparent constants without gradient; counts."""
    s = splats.to(torch.float32)
    values = (s.means, s.scales, s.quats, s.opacities[:, None], s.colors)
    finite = torch.isfinite(torch.cat(values, 1)).all(1)
    turned = s.quats.square().sum(1) >= const.QUAT_MIN_NORM2
    sound = finite & turned
    ones = torch.ones_like
    safe = Splats(
        torch.where(sound[:, None], s.means, ones(s.means)),
        torch.where(sound[:, None], s.scales, ones(s.scales)),
        torch.where(sound[:, None], s.quats, ones(s.quats)),
        torch.where(sound, s.opacities, torch.zeros_like(s.opacities)),
        torch.where(sound[:, None], s.colors, ones(s.colors)),
    )
    counts = {"non_finite": int((~finite).sum()) * views, "quaternion": int((finite & ~turned).sum()) * views}
    return safe, {k: n for k, n in counts.items() if n}
