"""The ``cuda`` backend: gsplat behind the same function (optional)."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from genre_tasks.errors import ConfigError, UnsupportedMachineError
from genre_tasks.render import constants as const
from genre_tasks.render.types import Cameras
from genre_tasks.scene.gaussians import Splats


def render_cuda(splats: Splats, cameras: Cameras) -> tuple[tuple[Tensor, Tensor, Tensor], dict[str, int]]:
    """Renders by gsplat on the GPU; differentiable in the splats, and in poses without distortion and shutter.

    gsplat clamps alpha at 0.999 where this project's other backends clamp at 0.99, and takes the plain determinant of
    the projected covariance: images differ where layers are nearly opaque (up to 0.009 of a layer's colour). With a
    distortion or a shutter it projects by the unscented transform, evaluates Gaussians along rays, finds each pixel's
    time itself, and depth has no gradient in positions. Its anti-aliasing has no floor under the compensation.

    Args:
        splats: on the GPU.
        cameras: V of them.

    Returns:
        Colour [V, H, W, 3], alpha and depth [V, H, W], float32, on the splats' device; and the culled counts by reason.

    Raises:
        UnsupportedMachineError: gsplat or a GPU is missing, or this gsplat has neither distortion nor rolling shutter.
        ConfigError: the splats are on the CPU; a shutter, and Gaussians with velocities of their own, which gsplat does
            not know; or anti-aliasing together with a distortion or a shutter.
        ValueError: the gradient in a pose is asked for with a distortion or a shutter; gsplat has none.
    """
    try:
        from gsplat import rasterization
    except ImportError as error:
        raise UnsupportedMachineError(
            "the cuda backend needs gsplat, which is not installed", remedy="Run `pip install -e '.[cuda]'` or use cpu"
        ) from error
    if not torch.cuda.is_available():
        raise UnsupportedMachineError("the cuda backend found no GPU", remedy="Use backend cpu")
    if splats.means.device.type != "cuda":
        raise ConfigError("the cuda backend got tensors on the CPU", remedy="Move the splats to the GPU, or use cpu")
    # Checked before any work on the GPU: what gsplat cannot render raises here with its remedy.
    options = _camera_options(splats, cameras)
    safe, culled = _replace_invalid(splats, len(cameras))
    like = safe.means
    # gsplat takes 3×3 matrices, with the pixel convention of this project.
    intrinsics = torch.zeros(len(cameras), 3, 3, device=like.device)
    fx, fy = cameras.focal_px.to(like).unbind(1)
    intrinsics[:, 0, 0] = fx
    intrinsics[:, 1, 1] = fy
    intrinsics[:, :2, 2] = cameras.center_px.to(like)
    intrinsics[:, 2, 2] = 1.0
    image, alpha, _ = rasterization(
        safe.means,
        safe.quats,
        safe.scales,
        safe.opacities,
        safe.colors,
        Ks=intrinsics,
        width=cameras.width_px,
        height=cameras.height_px,
        near_plane=const.NEAR_M,
        eps2d=const.BLUR_PX2,
        render_mode="RGB+D",
        packed=False,
        rasterize_mode="antialiased" if cameras.antialiased else "classic",
        **({"viewmats": cameras.camera_SE3_chunk.to(like)} | options),
    )
    # "D" is the accumulated Σ w z; "ED" would be divided by alpha.
    return (image[..., :3], alpha[..., 0], image[..., 3]), culled


def _camera_options(splats: Splats, cameras: Cameras) -> dict[str, Any]:
    # Arguments of ``rasterization`` for distortion and shutter; none where there is neither.
    has_distortion = cameras.distortion is not None and bool(cameras.distortion.any())
    has_rolling_shutter = cameras.shutter is not None and bool(cameras.shutter.readout_s.any())
    if not has_distortion and not has_rolling_shutter:
        return {}
    if cameras.antialiased:  # along rays nothing is blurred, and its compensation would make up for nothing
        raise ConfigError(
            "the cuda backend has no anti-aliasing with a lens distortion or a rolling shutter",
            remedy="Use backend cpu, or set effects.anti_aliasing=off",
        )
    import gsplat

    # The first releases with this function know neither; their error would be about an unexpected argument.
    if not hasattr(gsplat, "RollingShutterType"):
        raise UnsupportedMachineError(
            "this gsplat renders neither lens distortion nor rolling shutter",
            remedy="Run `pip install 'gsplat>=1.5.3'` or use backend cpu",
        )
    if has_rolling_shutter and splats.velocities is not None:
        raise ConfigError(
            "the cuda backend cannot move Gaussians during a readout", remedy="Use backend cpu, or leave velocities out"
        )
    if cameras.camera_SE3_chunk.requires_grad:
        raise ValueError("backend cuda has no gradient in camera_SE3_chunk with a distortion or a shutter; use cpu")
    like = splats.means.detach().to(torch.float32)
    options: dict[str, Any] = {"with_ut": True, "with_eval3d": True}
    if cameras.distortion is not None and has_distortion:
        k1, k2, p1, p2, k3 = cameras.distortion.to(like).unbind(1)
        zero = torch.zeros_like(k1)  # OpenCV's rational model: (1 + k1 r² + k2 r⁴ + k3 r⁶) / (1 + k4 r² + …)
        options["radial_coeffs"] = torch.stack([k1, k2, k3, zero, zero, zero], 1)
        options["tangential_coeffs"] = torch.stack([p1, p2], 1)
    if has_rolling_shutter:
        options["rolling_shutter"] = gsplat.RollingShutterType.ROLLING_TOP_TO_BOTTOM
        # gsplat's times end at the centres of the first and of the last row.
        end = 0.5 - 0.5 / cameras.height_px
        options["viewmats"] = _pose_during_readout(cameras, -end).to(like)
        options["viewmats_rs"] = _pose_during_readout(cameras, end).to(like)
    return options


def _pose_during_readout(cameras: Cameras, fraction: float) -> Tensor:
    # Poses [V, 4, 4], chunk to camera, ``fraction`` of a readout after the pose's time: the motion of ``Shutter``.
    assert cameras.shutter is not None
    time = fraction * cameras.shutter.readout_s[:, None]
    x, y, z = (cameras.shutter.turn_rad_s * time).unbind(1)
    zero = torch.zeros_like(x)
    cross = torch.stack([zero, -z, y, z, zero, -x, -y, x, zero], 1).view(-1, 3, 3)
    # The points move against the camera: by the inverse of its own motion.
    moved_SE3_camera = torch.zeros_like(cameras.camera_SE3_chunk)
    moved_SE3_camera[:, :3, :3] = torch.linalg.matrix_exp(-cross)
    moved_SE3_camera[:, :3, 3] = -cameras.shutter.velocity_m_s * time
    moved_SE3_camera[:, 3, 3] = 1
    return moved_SE3_camera @ cameras.camera_SE3_chunk


def _replace_invalid(splats: Splats, views: int) -> tuple[Splats, dict[str, int]]:
    # Float32 splats in which invalid Gaussians are harmless, transparent constants without gradient; and counts.
    s = splats.to(torch.float32)
    values = (s.means, s.scales, s.quats, s.opacities[:, None], s.colors)
    finite = torch.isfinite(torch.cat(values, 1)).all(1)
    oriented = s.quats.square().sum(1) >= const.QUAT_MIN_NORM2
    valid = finite & oriented
    ones = torch.ones_like
    # gsplat propagates NaN into all pixels of a tile and into every gradient, so invalid Gaussians must not reach it.
    safe = Splats(
        torch.where(valid[:, None], s.means, ones(s.means)),
        torch.where(valid[:, None], s.scales, ones(s.scales)),
        torch.where(valid[:, None], s.quats, ones(s.quats)),
        torch.where(valid, s.opacities, torch.zeros_like(s.opacities)),
        torch.where(valid[:, None], s.colors, ones(s.colors)),
    )
    counts = {"non_finite": int((~finite).sum()) * views, "quaternion": int((finite & ~oriented).sum()) * views}
    return safe, {k: n for k, n in counts.items() if n}
