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
from genre_tasks.render.lens_domain import ValidDomain, find_valid_domain
from genre_tasks.render.types import Cameras, VisibleRanges
from genre_tasks.scene.gaussians import Splats

SplatTensors = tuple[Tensor, Tensor, Tensor, Tensor, Tensor]
"""Means [N, 3], scales [N, 3], quaternions [N, 4], opacities [N], colours [N, 3] or [V, N, 3]."""

ImageTensors = tuple[Tensor, Tensor, Tensor]
"""Colour [V, H, W, 3], alpha [V, H, W], depth [V, H, W]."""


def check_status(status: int) -> None:
    """Turns what a function of the kernel returned into an error.

    Args:
        status: 0 is success.

    Raises:
        ResourceError: memory does not suffice, or the kernel failed.
    """
    if status == 1:
        raise ResourceError("not enough memory to render", remedy="Render fewer views a call, or smaller images")
    if status:
        raise ResourceError(
            "the renderer's CPU kernel failed", remedy="Render with backend reference and report the scene"
        )


class ForwardState:
    """What the kernel's backward pass needs of the forward pass; freed with this object.

    Attributes:
        handle: of the kernel's state.
        velocities: [N, 3] those of the forward pass, or ``None``; the kernel reads them again.
    """

    def __init__(self, handle: ctypes.c_void_p, velocities: Tensor | None) -> None:
        self.handle = handle
        self.velocities = velocities
        # A reference of its own: when the interpreter ends, modules may be gone before this object is.
        self._free = load_kernel().genre_free

    def __del__(self) -> None:
        self._free(self.handle)


def forward(
    splats: SplatTensors,
    cameras: Cameras,
    visible: VisibleRanges,
    threads: int,
    keep: bool,
    velocities: Tensor | None = None,
) -> tuple[ImageTensors, dict[str, int], ForwardState | None]:
    """Renders by the kernel, without autograd.

    Args:
        splats: contiguous float32 tensors on the CPU.
        cameras: V of them.
        visible: which Gaussians each view shows.
        threads: the result has the same bits at any number.
        keep: whether :func:`backward` will follow.
        velocities: [N, 3] float32, contiguous, as in ``Splats``.

    Returns:
        The images, the culled counts by reason, and with ``keep`` the state for :func:`backward`.

    Raises:
        ResourceError: the kernel is not compiled, or memory does not suffice.
    """
    kernel = load_kernel()
    views = len(cameras)
    height = cameras.height_px
    width = cameras.width_px
    # A few hundred bytes each: these copies cost nothing. The splats are read in place.
    poses = cameras.camera_SE3_chunk.detach().to("cpu", torch.float32).contiguous()
    lenses = torch.cat([cameras.focal_px, cameras.center_px], 1).detach().to("cpu", torch.float32).contiguous()
    distortions = _distortions(cameras)
    shutters = _shutters(cameras)
    # Not zeroed: the kernel writes every pixel.
    color = torch.empty(views, height, width, 3)
    alpha = torch.empty(views, height, width)
    depth = torch.empty_like(alpha)
    culled = (ctypes.c_longlong * len(CULL_REASONS))()
    # The ctypes arrays must outlive the call, so they have names.
    ranges = (ctypes.c_int * (2 * views))(*itertools.chain(*visible.per_view))
    handle = ctypes.c_void_p()
    status = kernel.genre_forward(
        len(splats[0]),
        *(s.data_ptr() for s in splats),
        splats[4].dim() == 3,
        _pointer(velocities),
        views,
        poses.data_ptr(),
        lenses.data_ptr(),
        _pointer(distortions),
        _pointer(shutters),
        cameras.antialiased,
        width,
        height,
        threads,
        visible.shared,
        ranges,
        color.data_ptr(),
        alpha.data_ptr(),
        depth.data_ptr(),
        culled,
        ctypes.byref(handle) if keep else None,
    )
    check_status(status)
    counts = {reason: n for reason, n in zip(CULL_REASONS, culled, strict=True) if n}
    return (color, alpha, depth), counts, ForwardState(handle, velocities) if keep else None


def backward(
    state: ForwardState,
    splats: SplatTensors,
    images: ImageTensors,
    image_gradients: ImageTensors,
    threads: int,
    out: SplatTensors,
    residual: Tensor | None = None,
    view_weights: Tensor | None = None,
) -> Tensor | None:
    """Computes the gradients of splats from those of the images, without autograd.

    Args:
        state: of the forward pass.
        splats: as given to :func:`forward`.
        images: as returned by it.
        image_gradients: with respect to colour, alpha and depth.
        threads: the result has the same bits at any number.
        out: contiguous float32 tensors; the gradients are written there.
        residual: [V, H, W, 3] an image r whose distribution over the Gaussians is asked for, too.
        view_weights: [V] float32, how much each view counts in it; ``None``: 1.

    Returns:
        With a ``residual``, how much of it each Gaussian covers [N, 5]: the sums over all pixels and views of w r,
        w ‖r‖² and w, where w is the Gaussian's weight in the pixel, times that of the view.

    Raises:
        ResourceError: memory does not suffice.
        ValueError: the residual or the weights of views have another shape or type.
    """
    _check_residual(images, residual, view_weights)
    # Autograd may hand over expanded or transposed tensors, while the kernel counts in plain rows.
    view_weights = None if view_weights is None else view_weights.contiguous()
    image_gradients_ = [x.contiguous() for x in image_gradients]
    sums = None if residual is None else torch.empty(len(splats[0]), 5)
    residual = None if residual is None else residual.contiguous()
    status = load_kernel().genre_backward(
        state.handle,
        len(splats[0]),
        *(s.data_ptr() for s in splats),
        splats[4].dim() == 3,
        _pointer(state.velocities),
        *(x.data_ptr() for x in images),
        *(x.data_ptr() for x in image_gradients_),
        _pointer(residual),
        _pointer(view_weights),
        threads,
        *(g.data_ptr() for g in out),
        _pointer(sums),
    )
    check_status(status)
    return sums


def _check_residual(images: ImageTensors, residual: Tensor | None, view_weights: Tensor | None) -> None:
    # The kernel gets addresses: it would read other bytes than are meant, or beyond their end.
    for name, value, shape in (
        ("a residual", residual, images[0].shape),
        ("weights of views", view_weights, images[0].shape[:1]),
    ):
        if value is not None and (value.shape != shape or value.dtype != torch.float32):
            found = f"{value.dtype} {tuple(value.shape)}"
            raise ValueError(f"expected {name} as float32 {tuple(shape)}, got {found}")


def _pointer(tensor: Tensor | None) -> int | None:
    return None if tensor is None else tensor.data_ptr()


def _distortions(cameras: Cameras) -> Tensor | None:
    # [V, 10] as the kernel takes them: coefficients, square of the fold radius, limits of the linearisation.
    domains = [find_valid_domain(cameras, v) for v in range(len(cameras))]
    if cameras.distortion is None or not any(domains):
        return None
    # The kernel takes one table for all views. A view that does not distort has coefficients of 0 in it, by which the
    # kernel knows, and never reads its limits.
    undistorted = ValidDomain(torch.inf, 0.0, 0.0, 0.0, 0.0)
    per_view = [d or undistorted for d in domains]
    limits = torch.tensor([[d.fold_radius**2, d.left, d.right, d.top, d.bottom] for d in per_view])
    return torch.cat([cameras.distortion.detach().to("cpu", torch.float32), limits], 1).contiguous()


def _shutters(cameras: Cameras) -> Tensor | None:
    # [V, 7] as the kernel takes them: readout, velocity, turn.
    shutter = cameras.shutter
    if shutter is None:
        return None
    parts = (shutter.readout_s[:, None], shutter.velocity_m_s, shutter.turn_rad_s)
    return torch.cat(parts, 1).detach().to("cpu", torch.float32).contiguous()


class _Rasterise(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any,
        cameras: Cameras,
        visible: VisibleRanges,
        threads: int,
        culled: dict[str, int],
        means: Tensor,
        scales: Tensor,
        quats: Tensor,
        opacities: Tensor,
        colors: Tensor,
        velocities: Tensor | None,
    ) -> ImageTensors:
        # Without a backward pass the kernel hands its memory back to the pool at once.
        splats = (means, scales, quats, opacities, colors)
        keep = any(ctx.needs_input_grad)
        images, counts, ctx.state = forward(splats, cameras, visible, threads, keep, velocities)
        culled.update(counts)
        ctx.cameras = cameras
        ctx.visible = visible
        ctx.threads = threads
        ctx.velocities = velocities
        ctx.save_for_backward(*splats, *images)
        return images

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, v_color: Tensor, v_alpha: Tensor, v_depth: Tensor) -> tuple[Tensor | None, ...]:
        saved = ctx.saved_tensors
        splats = saved[:5]
        images = saved[5:]
        # Taken out of the context, so that its memory goes back to the pool as soon as this pass ends.
        state = ctx.state
        ctx.state = None
        if state is None:  # a second backward through a retained graph: the state was given back after the first
            state = forward(splats, ctx.cameras, ctx.visible, ctx.threads, True, ctx.velocities)[2]
        means, scales, quats, opacities, colors = (torch.empty_like(s) for s in splats)
        grads = (means, scales, quats, opacities, colors)
        backward(state, splats, images, (v_color, v_alpha, v_depth), ctx.threads, grads)
        return (None, None, None, None, *grads, None)


def _tensors_of(splats: Splats) -> SplatTensors:
    tensors = (splats.means, splats.scales, splats.quats, splats.opacities, splats.colors)
    # Other devices would be copied without a word, over and over in an optimisation: better to fail.
    if any(t.device.type != "cpu" for t in tensors):
        raise ValueError(f"expected tensors on the cpu for backend cpu, got {splats.means.device}")
    means, scales, quats, opacities, colors = (t.to(torch.float32).contiguous() for t in tensors)
    return means, scales, quats, opacities, colors


def _velocities_of(splats: Splats) -> Tensor | None:
    return None if splats.velocities is None else splats.velocities.detach().to("cpu", torch.float32).contiguous()


def run_forward(splats: Splats, cameras: Cameras) -> ForwardState:
    """Renders on one thread and gives the kernel's state, from which a benchmark counts the work done.

    Args:
        splats: on the CPU.
        cameras: V of them.
    """
    with torch.no_grad():
        visible = VisibleRanges.everything(len(splats), len(cameras))
        state = forward(_tensors_of(splats), cameras, visible, 1, True, _velocities_of(splats))[2]
    assert state is not None
    return state


def render_cpu(
    splats: Splats, cameras: Cameras, visible: VisibleRanges, threads: int | None
) -> tuple[ImageTensors, dict[str, int]]:
    """Renders by the kernel; differentiable in the splats.

    Memory, with N Gaussians and P pairs of a footprint and a tile of 16×16 pixels in a view: 72 N + 11 P bytes a view
    from forward to backward (4 N more with a rolling shutter), and 76 N + 68 P a thread while it works on one, each up
    to a quarter more. Up to 512 MB of either stay for the next call.

    Args:
        splats: on the CPU.
        cameras: V of them.
        visible: which Gaussians each view shows.
        threads: ``None``: torch's number. The bits of images and gradients do not depend on it.

    Returns:
        Colour [V, H, W, 3], alpha and depth [V, H, W], float32; and the culled counts by reason.

    Raises:
        ValueError: a tensor is not on the CPU.
        ResourceError: the kernel is not compiled, or memory does not suffice.
    """
    # An autograd function returns tensors only: the counts come back through this dictionary.
    culled: dict[str, int] = {}
    threads = threads or torch.get_num_threads()
    images = _Rasterise.apply(cameras, visible, threads, culled, *_tensors_of(splats), _velocities_of(splats))
    return images, culled
