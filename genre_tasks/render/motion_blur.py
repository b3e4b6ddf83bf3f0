"""Motion blur: an image is the mean, in linear light, of what several moments of its exposure see.

A view with motion blur is rendered as sharp views at those moments, its blur samples, by any backend and without its
knowledge. Here their images are averaged, and the gradient of the average is distributed over them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
import torch
from scipy.linalg import expm
from torch import Tensor
from torch.autograd.function import once_differentiable

from genre_tasks.logs.types import Float64, Lens, MotionBlur, RollingShutter
from genre_tasks.render.types import Render
from genre_tasks.threads import torch_threads

BLUR_SAMPLE_COUNT = 5
"""Samples of a blurred image: an edge that moves b px becomes steps of b / 5 px, no wider than a pixel, and so no
sharper than any edge in an image, up to 5 px. Odd, so that one of them is at the pose's own time."""

# sRGB (IEC 61966-2-1): linear up to the toe.
_TOE = 0.04045
_SLOPE = 12.92
_OFFSET = 0.055
_POWER = 2.4


class PosedView(Protocol):
    """What a renderer needs of a view: a log frame, a pose [4, 4] and a lens. Between frames actors are between poses.

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
class BlurSample:
    """A sharp view at one moment of an exposure.

    Attributes:
        frame: log frame, a fraction between frames.
        chunk_SE3_camera: [4, 4] at that moment.
        lens: of the blurred view.
        shutter: of the blurred view.
    """

    frame: float
    chunk_SE3_camera: Float64
    lens: Lens
    shutter: RollingShutter | None


@dataclass(frozen=True)
class BlurSamples:
    """Views to render in place of V views, of which some have motion blur.

    Attributes:
        views: those without motion blur as they are, the others as ``BLUR_SAMPLE_COUNT`` samples each.
        parts: [V] which of ``views`` belong to each of the V views.
    """

    views: tuple[PosedView, ...]
    parts: tuple[slice, ...]

    @staticmethod
    def from_views(views: Sequence[PosedView]) -> BlurSamples | None:
        """Splits the exposures of V views.

        Args:
            views: with or without motion blur; an exposure of 0 is none.

        Returns:
            ``None`` where no view has motion blur.
        """
        if not any(_blur_of(v) for v in views):
            return None
        samples_by_view = [_blur_samples(v) for v in views]
        # Slices into one list of views, so that all samples of all views are rendered in one call.
        ends = np.cumsum([len(samples) for samples in samples_by_view]).tolist()
        parts = tuple(slice(end - len(samples), end) for samples, end in zip(samples_by_view, ends, strict=True))
        return BlurSamples(tuple(sample for samples in samples_by_view for sample in samples), parts)

    @property
    def middle_indices(self) -> list[int]:
        """For each view the index of the sample at its pose's own time."""
        return [(p.start + p.stop) // 2 for p in self.parts]

    def average(self, image: Render) -> Render:
        """Averages a render of the samples; differentiable.

        Args:
            image: of ``views``.

        Returns:
            V images. Alpha and depth are those at the pose's own time, which LiDAR's returns belong to.
        """
        # View by view, since a sharp view has one sample and a blurred one several.
        color = torch.stack([_MeanInLinearLight.apply(image.color[p]) for p in self.parts])
        return Render(color, image.alpha[self.middle_indices], image.depth[self.middle_indices], image.culled)


def mean_in_linear_light(color: Tensor) -> Tensor:
    """Averages images as a sensor does.

    Args:
        color: [K, H, W, 3] sRGB.

    Returns:
        [H, W, 3] sRGB, the mean in linear light; a single image as it is. Run it on one thread for equal bits.

    >>> black_and_white = torch.stack([torch.zeros(1, 1, 3), torch.ones(1, 1, 3)])
    >>> round(float(mean_in_linear_light(black_and_white).mean()), 4)
    0.7354
    """
    return color[0] if len(color) == 1 else _encode_srgb(_decode_srgb(color).mean(0))


def mean_in_linear_light_gradient(color: Tensor, mean_gradient: Tensor) -> Tensor:
    """Computes the gradient of :func:`mean_in_linear_light`. Run it on one thread for equal bits.

    Args:
        color: [K, H, W, 3] sRGB, the images.
        mean_gradient: [H, W, 3] with respect to their mean.

    Returns:
        [K, H, W, 3] with respect to ``color``.
    """
    if len(color) == 1:
        return mean_gradient[None]
    light = _decode_srgb(color)
    mean = light.mean(0)
    in_toe = mean <= _TOE / _SLOPE
    # The slope of the encoding, written with its own result, which costs one power less.
    encoding_slope = torch.where(
        in_toe, _SLOPE, (_encode_srgb(mean) + _OFFSET) / (_POWER * mean.clamp_min(_TOE / _SLOPE))
    )
    light_gradient = mean_gradient * encoding_slope
    decoding_slope = torch.where(color <= _TOE, 1 / _SLOPE, _POWER * light / (color.clamp_min(_TOE) + _OFFSET))
    return decoding_slope * (light_gradient / len(color))


def _decode_srgb(coded: Tensor) -> Tensor:
    # Clamped, so that the branch not taken is finite and its gradient no NaN.
    power = ((coded.clamp_min(_TOE) + _OFFSET) / (1 + _OFFSET)) ** _POWER
    return torch.where(coded <= _TOE, coded / _SLOPE, power)


def _encode_srgb(linear: Tensor) -> Tensor:
    toe = _TOE / _SLOPE
    # The same here: the slope of a power below 1 has no end at 0.
    power = (1 + _OFFSET) * linear.clamp_min(toe) ** (1 / _POWER) - _OFFSET
    return torch.where(linear <= toe, linear * _SLOPE, power)


class _MeanInLinearLight(torch.autograd.Function):
    # On one thread: a power's last bits depend on where threads' pieces of a tensor end.

    @staticmethod
    def forward(ctx: Any, color: Tensor) -> Tensor:
        ctx.save_for_backward(color)
        with torch_threads(1):
            return mean_in_linear_light(color).clone()

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, mean_gradient: Tensor) -> Tensor:
        (color,) = ctx.saved_tensors
        with torch_threads(1):
            return mean_in_linear_light_gradient(color, mean_gradient)


def _blur_of(view: PosedView) -> MotionBlur | None:
    blur = getattr(view, "blur", None)
    return blur if blur is not None and blur.exposure_s else None


def _blur_samples(view: PosedView) -> Sequence[PosedView]:
    # The view itself without motion blur; else its samples, each in the middle of an equal part of the exposure.
    blur = _blur_of(view)
    if blur is None:
        return (view,)
    times = ((np.arange(BLUR_SAMPLE_COUNT) + 0.5) / BLUR_SAMPLE_COUNT - 0.5) * blur.exposure_s
    return [_blur_sample(view, blur, float(t)) for t in times]


def _blur_sample(view: PosedView, blur: MotionBlur, time_s: float) -> BlurSample:
    x, y, z = blur.turn_rad_s
    vx, vy, vz = blur.velocity_m_s
    # Velocity and turn stay as they are in the camera's own axes, as they do while an image is read out.
    rates = np.array([[0, -z, y, vx], [z, 0, -x, vy], [-y, x, 0, vz], [0, 0, 0, 0]])
    return BlurSample(
        frame=view.frame + time_s / blur.frame_s if blur.frame_s else view.frame,
        chunk_SE3_camera=view.chunk_SE3_camera @ expm(time_s * rates),
        lens=view.lens,
        shutter=getattr(view, "shutter", None),
    )
