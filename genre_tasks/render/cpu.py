"""The ``cpu`` backend: the compiled kernel as a ``torch.autograd.Function``."""

from __future__ import annotations

import ctypes
import itertools
from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from genre_tasks.errors import ResourceError
from genre_tasks.render.constants import CULL_REASONS
from genre_tasks.render.kernel.library import load_kernel
from genre_tasks.render.lens_domain import Domain, domain_of
from genre_tasks.render.types import Cameras, Shown
from genre_tasks.scene.gaussians import Splats

Arrays = tuple[Tensor, Tensor, Tensor, Tensor, Tensor]
Images = tuple[Tensor, Tensor, Tensor]


def check_status(status: int) -> None:
    """Raises ``ResourceError`` for what a kernel function returned, unless it is 0."""
    if status == 1:
        raise ResourceError("not enough memory to render", remedy="Render fewer views a call, or smaller images")
    if status:
        raise ResourceError(
            "the renderer's CPU kernel failed", remedy="Render with backend reference and report the scene"
        )


class _Batch:
    """The kernel's state after a forward pass, freed with this object, and the velocities that it was given."""

    def __init__(self, handle: ctypes.c_void_p, velocities: Tensor | None) -> None:
        self.handle, self.velocities = handle, velocities
        self._free = load_kernel().genre_free

    def __del__(self) -> None:
        self._free(self.handle)


def forward(
    arrays: Arrays, cameras: Cameras, shown: Shown, threads: int, keep: bool, velocities: Tensor | None = None
) -> tuple[Images, dict[str, int], _Batch | None]:
    """The images of contiguous ``arrays``, the culled counts, and with ``keep`` the state for :func:`backward`.

    Colours are [N, 3], or [V, N, 3] where they differ from view to view.

    ``velocities`` [N, 3] float32, contiguous, as in ``Splats``.
    """
    kernel = load_kernel()
    views, height, width = len(cameras), cameras.height_px, cameras.width_px
    poses = cameras.camera_SE3_chunk.detach().to("cpu", torch.float32).contiguous()
    lenses = torch.cat([cameras.focal_px, cameras.center_px], 1).detach().to("cpu", torch.float32).contiguous()
    distortions, shutters = _distortions(cameras), _shutters(cameras)
    color, alpha = torch.empty(views, height, width, 3), torch.empty(views, height, width)
    depth = torch.empty_like(alpha)
    culled = (ctypes.c_longlong * len(CULL_REASONS))()
    own = (ctypes.c_int * (2 * views))(*itertools.chain(*shown.own))
    handle = ctypes.c_void_p()
    of_cameras = poses.data_ptr(), lenses.data_ptr(), _pointer(distortions), _pointer(shutters)
    status = kernel.genre_forward(
        len(arrays[0]),
        *(a.data_ptr() for a in arrays),
        arrays[4].dim() == 3,
        _pointer(velocities),
        views,
        *of_cameras,
        cameras.antialiased,
        width,
        height,
        threads,
        shown.shared,
        own,
        color.data_ptr(),
        alpha.data_ptr(),
        depth.data_ptr(),
        culled,
        ctypes.byref(handle) if keep else None,
    )
    check_status(status)
    counts = {reason: n for reason, n in zip(CULL_REASONS, culled, strict=True) if n}
    return (color, alpha, depth), counts, _Batch(handle, velocities) if keep else None


def backward(
    batch: _Batch,
    arrays: Arrays,
    images: Images,
    by_images: Images,
    threads: int,
    out: Arrays,
    residual: Tensor | None = None,
    shares: Tensor | None = None,
) -> Tensor | None:
    """Writes the gradients of ``arrays`` to ``out``, from those of the images.

    With a ``residual`` r [V, H, W, 3] it returns what of it each Gaussian shows, [N, 5]: the sums over all pixels of
    w r, w ‖r‖² and w, where w is the Gaussian's share of the pixel; a view's times its own of ``shares`` [V], float32.
    """
    v = [x.contiguous() for x in by_images]
    back = None if residual is None else torch.empty(len(arrays[0]), 5)
    residual = None if residual is None else residual.contiguous()
    status = load_kernel().genre_backward(
        batch.handle,
        len(arrays[0]),
        *(a.data_ptr() for a in arrays),
        arrays[4].dim() == 3,
        _pointer(batch.velocities),
        *(a.data_ptr() for a in images),
        *(x.data_ptr() for x in v),
        _pointer(residual),
        _pointer(shares),
        threads,
        *(g.data_ptr() for g in out),
        _pointer(back),
    )
    check_status(status)
    return back


def _pointer(tensor: Tensor | None) -> int | None:
    return None if tensor is None else tensor.data_ptr()


def _distortions(cameras: Cameras) -> Tensor | None:
    """[V, 10] as the kernel takes them: coefficients, square of the fold radius, limits of the linearisation."""
    domains = [domain_of(cameras, v) for v in range(len(cameras))]
    if cameras.distortion is None or not any(domains):
        return None
    straight = Domain(torch.inf, 0.0, 0.0, 0.0, 0.0)
    each = [d or straight for d in domains]
    limits = torch.tensor([[d.fold_radius**2, d.left, d.right, d.top, d.bottom] for d in each])
    return torch.cat([cameras.distortion.detach().to("cpu", torch.float32), limits], 1).contiguous()


def _shutters(cameras: Cameras) -> Tensor | None:
    """[V, 7] as the kernel takes them: readout, velocity, turn."""
    if (shutter := cameras.shutter) is None:
        return None
    parts = shutter.readout_s[:, None], shutter.velocity_m_s, shutter.turn_rad_s
    return torch.cat(parts, 1).detach().to("cpu", torch.float32).contiguous()


class _Rasterise(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any,
        cameras: Cameras,
        shown: Shown,
        threads: int,
        culled: dict[str, int],
        means: Tensor,
        scales: Tensor,
        quats: Tensor,
        opacities: Tensor,
        colors: Tensor,
        velocities: Tensor | None,
    ) -> Images:
        arrays = (means, scales, quats, opacities, colors)
        keep = any(ctx.needs_input_grad)
        images, counts, ctx.batch = forward(arrays, cameras, shown, threads, keep, velocities)
        culled.update(counts)
        ctx.cameras, ctx.shown, ctx.threads, ctx.velocities = cameras, shown, threads, velocities
        ctx.save_for_backward(*arrays, *images)
        return images

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, v_color: Tensor, v_alpha: Tensor, v_depth: Tensor) -> tuple[Tensor | None, ...]:
        saved = ctx.saved_tensors
        arrays, images = saved[:5], saved[5:]
        batch, ctx.batch = ctx.batch, None
        if batch is None:  # a second backward through a retained graph: the state was given back after the first
            batch = forward(arrays, ctx.cameras, ctx.shown, ctx.threads, True, ctx.velocities)[2]
        means, scales, quats, opacities, colors = (torch.empty_like(a) for a in arrays)
        grads = (means, scales, quats, opacities, colors)
        backward(batch, arrays, images, (v_color, v_alpha, v_depth), ctx.threads, grads)
        return (None, None, None, None, *grads, None)


def _arrays(splats: Splats) -> Arrays:
    arrays = (splats.means, splats.scales, splats.quats, splats.opacities, splats.colors)
    if any(a.device.type != "cpu" for a in arrays):
        raise ValueError(f"expected tensors on the cpu for backend cpu, got {splats.means.device}")
    means, scales, quats, opacities, colors = (a.to(torch.float32).contiguous() for a in arrays)
    return means, scales, quats, opacities, colors


def _velocities(splats: Splats) -> Tensor | None:
    return None if splats.velocities is None else splats.velocities.detach().to("cpu", torch.float32).contiguous()


def forward_state(splats: Splats, cameras: Cameras) -> _Batch:
    """The kernel's state after a forward pass on one thread."""
    with torch.no_grad():
        shown = Shown.all_of(len(splats), len(cameras))
        state = forward(_arrays(splats), cameras, shown, 1, True, _velocities(splats))[2]
    assert state is not None
    return state


def render_cpu(splats: Splats, cameras: Cameras, shown: Shown, threads: int | None) -> tuple[Images, dict[str, int]]:
    """Colour [V, H, W, 3], alpha and depth [V, H, W], float32, and the culled counts; differentiable in the splats.

    ``threads`` ``None`` takes torch's number. The bits of images and gradients do not depend on it. Memory, with N
    Gaussians and P pairs of a footprint and a tile of 16×16 pixels in a view: 72 N + 11 P bytes a view from forward to
    backward (4 N more with a rolling shutter), and 76 N + 68 P a thread while it works on one, each up to a quarter
    more; up to 512 MB of either is kept for the next call.
    """
    culled: dict[str, int] = {}
    threads = threads or torch.get_num_threads()
    images = _Rasterise.apply(cameras, shown, threads, culled, *_arrays(splats), _velocities(splats))
    return images, culled
