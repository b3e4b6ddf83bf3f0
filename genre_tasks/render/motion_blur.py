"""Motion blur: an image is the mean, in linear light, of what several moments of its exposure see.

A view with motion blur is rendered as views of its moments, by any backend and without their knowing; their images are
brought together here, and gradients taken apart.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
import torch
from scipy.linalg import expm
from torch import Tensor
from torch.autograd.function import once_differentiable

from genre_tasks.logs.types import Float64, Lens, MotionBlur, RollingShutter
from genre_tasks.render.types import Render

MOMENTS = 5
"""A blurred image is the mean of so many: an edge that moves b px becomes steps of b / 5 px, no wider than a pixel, and
so no sharper than any edge in an image, up to 5 px. Odd, so that one of them is at the pose's own time."""

_TOE, _SLOPE, _OFFSET, _POWER = 0.04045, 12.92, 0.055, 2.4
"""sRGB (IEC 61966-2-1): linear up to the toe."""


class PosedView(Protocol):
    """What is asked of a view: a log frame, a pose [4, 4] and a lens. Between frames actors are between their poses.

    A view with a rolling shutter has an attribute ``shutter``, a ``RollingShutter`` or ``None``; one with motion blur
    ``blur``, a ``MotionBlur`` or ``None``.
    """

    @property
    def frame(self) -> float: ...
    @property
    def chunk_SE3_camera(self) -> Float64: ...
    @property
    def lens(self) -> Lens: ...


@dataclass(frozen=True)
class Moment:
    """A view at one moment of its exposure."""

    frame: float
    chunk_SE3_camera: Float64  # [4, 4]
    lens: Lens
    shutter: RollingShutter | None


@dataclass(frozen=True)
class Moments:
    """Views, those with motion blur as ``MOMENTS`` views, and which of ``views`` are each one's (``parts``)."""

    views: tuple[PosedView, ...]
    parts: tuple[slice, ...]

    @staticmethod
    def of(views: Sequence[PosedView]) -> Moments | None:
        """``None`` where no view has motion blur; an exposure of 0 is none."""
        if not any(_blur_of(v) for v in views):
            return None
        each = [_moments(v) for v in views]
        ends = np.cumsum([len(m) for m in each]).tolist()
        parts = tuple(slice(end - len(m), end) for m, end in zip(each, ends, strict=True))
        return Moments(tuple(m for own in each for m in own), parts)

    @property
    def middle(self) -> list[int]:
        """For each view the index of the moment at its pose's own time."""
        return [(p.start + p.stop) // 2 for p in self.parts]

    def recorded(self, image: Render) -> Render:
        """What the views show, of a render of their moments: differentiable.

        Alpha and depth are those at the pose's own time, which LiDAR's returns belong to.
        """
        color = torch.stack([_Mean.apply(image.color[p]) for p in self.parts])
        return Render(color, image.alpha[self.middle], image.depth[self.middle], image.culled)


def mean(color: Tensor) -> Tensor:
    """[K, H, W, 3] sRGB → [H, W, 3], the mean in linear light; one image as it is. Run on one thread for equal bits."""
    return color[0] if len(color) == 1 else _encoded(_linear(color).mean(0))


def mean_gradient(color: Tensor, by_mean: Tensor) -> Tensor:
    """The gradient [K, H, W, 3] with respect to ``color`` from that of :func:`mean`. On one thread, as there."""
    if len(color) == 1:
        return by_mean[None]
    light = _linear(color)
    total = light.mean(0)
    low = total <= _TOE / _SLOPE
    by_total = by_mean * torch.where(
        low, _SLOPE, (_encoded(total) + _OFFSET) / (_POWER * total.clamp_min(_TOE / _SLOPE))
    )
    slopes = torch.where(color <= _TOE, 1 / _SLOPE, _POWER * light / (color.clamp_min(_TOE) + _OFFSET))
    return slopes * (by_total / len(color))


def _linear(coded: Tensor) -> Tensor:
    power = ((coded.clamp_min(_TOE) + _OFFSET) / (1 + _OFFSET)) ** _POWER
    return torch.where(coded <= _TOE, coded / _SLOPE, power)


def _encoded(linear: Tensor) -> Tensor:
    toe = _TOE / _SLOPE
    power = (1 + _OFFSET) * linear.clamp_min(toe) ** (1 / _POWER) - _OFFSET
    return torch.where(linear <= toe, linear * _SLOPE, power)


class _Mean(torch.autograd.Function):
    """:func:`mean`. On one thread: a power's last bits depend on where threads' pieces of a tensor end."""

    @staticmethod
    def forward(ctx: Any, color: Tensor) -> Tensor:
        ctx.save_for_backward(color)
        with _one_thread():
            return mean(color).clone()

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, by_mean: Tensor) -> Tensor:
        (color,) = ctx.saved_tensors
        with _one_thread():
            return mean_gradient(color, by_mean)


@contextmanager
def _one_thread() -> Iterator[None]:
    threads = torch.get_num_threads()
    try:
        torch.set_num_threads(1)
        yield
    finally:
        torch.set_num_threads(threads)


def _blur_of(view: PosedView) -> MotionBlur | None:
    blur = getattr(view, "blur", None)
    return blur if blur is not None and blur.exposure_s else None


def _moments(view: PosedView) -> Sequence[PosedView]:
    """The view itself without motion blur; else its moments, each in the middle of an equal part of the exposure."""
    blur = _blur_of(view)
    if blur is None:
        return (view,)
    times = ((np.arange(MOMENTS) + 0.5) / MOMENTS - 0.5) * blur.exposure_s
    return [_moment(view, blur, float(t)) for t in times]


def _moment(view: PosedView, blur: MotionBlur, time_s: float) -> Moment:
    x, y, z = blur.turn_rad_s
    vx, vy, vz = blur.velocity_m_s
    # Velocity and turn stay as they are in the camera's own axes, as they do while an image is read out.
    rates = np.array([[0, -z, y, vx], [z, 0, -x, vy], [-y, x, 0, vz], [0, 0, 0, 0]])
    frame = view.frame + time_s / blur.frame_s if blur.frame_s else view.frame
    return Moment(frame, view.chunk_SE3_camera @ expm(time_s * rates), view.lens, getattr(view, "shutter", None))
