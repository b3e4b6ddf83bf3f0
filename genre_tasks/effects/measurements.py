"""What several effects look at, each read or computed once: images, LiDAR returns in images, one point's colours."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from genre_tasks.logs.types import Camera, Float32, Float64
from genre_tasks.scene.chunk import Chunk, View
from genre_tasks.scene.image_decoding import decode_pixels
from genre_tasks.scene.projection import Projected, project
from genre_tasks.scene.transforms import path_distance
from genre_tasks.scene.visibility import visible

MOMENTS = 10
SAMPLES = 6000
"""Static points whose colours are compared between images."""

SAMPLE_RANGE_M = 25.0
"""Farther ones are a pixel among others: their colour is the neighbourhood's."""

_ROUNDS, _FEW, _LEAST = 12, 10, 1e-6
_SKY = 0.9
"""What haze looks like: as bright as the sky, which this quantile of the images stands for."""

_OUTLIER = 0.1
"""Residuals of log colour from here on count less and less (Cauchy): wrong pixels, reflections, moving shadows."""

_DARK = 8.0 / 255
_BRIGHT = 247.0 / 255
"""Outside, a pixel is clipped or mostly noise, and its logarithm says nothing of the gain."""


@dataclass(frozen=True)
class Colours:
    """Log of linear colour of V images at P static points: ``value`` [V, P, 3], NaN where a view does not see it, or
    sees it clipped or dark.

    ``texture`` [V, P]: standard deviation of the same within 3 × 3 pixels, mean over channels. ``distance`` [V, P]
    metres along the camera's axis.
    """

    views: tuple[View, ...]
    value: Float64
    texture: Float64
    distance: Float64


class Seen:
    """A chunk and its cameras; what follows from them is made when an effect first asks for it."""

    def __init__(self, chunk: Chunk, cameras: Sequence[Camera]) -> None:
        self.chunk = chunk
        self.cameras = {c.name: c for c in cameras if c.name in chunk.camera_names}

    @cached_property
    def sources(self) -> tuple[View, ...]:
        """The source views."""
        return self.chunk.of_role("source")

    @cached_property
    def pixels(self) -> dict[tuple[str, int], NDArray[np.uint8]]:
        """The source images at the working resolution, [H, W, 3], by camera and frame."""
        return {(v.camera, v.frame): self.decoded(v) for v in self.sources}

    def decoded(self, view: View) -> NDArray[np.uint8]:
        """A view's image at the working resolution."""
        return decode_pixels(view.image, view.lens.width_px, view.lens.height_px)

    @cached_property
    def over_time(self) -> dict[str, NDArray[np.uint8]]:
        """By camera, some ``MOMENTS`` of its images spread over the chunk, held-out ones too: [F, H, W, 3]."""
        out = {}
        for camera in self.chunk.camera_names:
            views = [v for v in self.chunk.views if v.camera == camera]
            chosen = views[:: max(1, len(views) // MOMENTS)]
            out[camera] = np.stack([self.decoded(v) for v in chosen]) if chosen else np.zeros((0, 1, 1, 3), np.uint8)
        return out

    @cached_property
    def returns(self) -> list[Projected]:
        """For each source view, the static LiDAR returns of its own frame that fall into it."""
        points = self.chunk.static
        return [project(points.positions[points.frames == v.frame], v.chunk_SE3_camera, v.lens) for v in self.sources]

    @cached_property
    def colours(self) -> Colours:
        """The colours of up to ``SAMPLES`` static points near the path in all source images that see them."""
        points = self.chunk.static
        fit = points.frames >= 0
        fit &= points.colored & (path_distance(points.positions, self.chunk.chunk_SE3_ego) < SAMPLE_RANGE_M)
        near = np.flatnonzero(fit)
        chosen = np.sort(np.random.default_rng(0).choice(near, min(SAMPLES, len(near)), replace=False))
        rank = np.full(len(points), -1)
        rank[chosen] = np.arange(len(chosen))
        value = np.full((len(self.sources), len(chosen), 3), np.nan)
        texture, distance = np.full(value.shape[:2], np.nan), np.zeros(value.shape[:2])
        for k, view in enumerate(self.sources):
            index, uv, depth = visible(points.positions, view)
            ours = (rank[index] >= 0) & (depth < SAMPLE_RANGE_M)
            image = self.pixels[view.camera, view.frame]
            at = rank[index[ours]]
            value[k, at], texture[k, at] = _logs(image, uv[ours])
            distance[k, at] = depth[ours]
        return Colours(self.sources, value, texture, distance)

    @property
    def gains(self) -> Float64:
        """[V, 3] log gain of each source image, zero mean over those in :attr:`linked`: what explains shared points."""
        return self._explained[0]

    @property
    def unexplained(self) -> Float64:
        """[V, P, 3] log colours without a point's own and an image's gain; NaN where a point is in one image alone."""
        return self._explained[1]

    @cached_property
    def linked(self) -> NDArray[np.bool_]:
        """[V]: the image shares enough points with others for its gain to be known."""
        return _shared(self.colours.value).sum(1) >= _FEW

    @cached_property
    def _explained(self) -> tuple[Float64, Float64]:
        """Log colour = the point's + the image's gain + haze, by least squares that outliers count little in.

        Haze lightens what is seen from afar: left out, it would pass for gain, as one camera, or one moment, sees from
        afar what another sees from nearby.
        """
        kept = _shared(self.colours.value)
        sky = np.quantile([_linear(p[::4, ::4].reshape(-1, 3) / 255.0) for p in self.pixels.values()], _SKY, (0, 1))
        gain, left = _explain(np.where(kept[..., None], self.colours.value, 0.0), self.colours.distance, kept, sky)
        known = self.linked
        gain -= gain[known].mean(0) if known.any() else 0
        return gain, left


def _explain(value: Float64, distance: Float64, kept: NDArray[np.bool_], sky: Float64) -> tuple[Float64, Float64]:
    """([V, 3] gain, [V, P, 3] what is left, NaN where not ``kept``) of log colours [V, P, 3]. Gauss–Newton.

    Over a distance d, haze of strength h makes a colour c to c + h d (sky − c). One h holds for all: with a number
    for each channel it would be free to trade a drift of gain for haze while the vehicle drives ahead.
    """
    light = value.transpose(2, 0, 1)  # [3, V, P]
    weight = kept.astype(np.float64)
    own, gain, haze = _mean(light, weight), np.zeros((3, len(kept), 1)), 0.0
    for _ in range(_ROUNDS):
        term = distance * (sky[:, None, None] * np.exp(-own) - 1)
        share = np.maximum(1 + haze * term, _LEAST)
        slope = term / share
        y = light - np.log(share) + haze * slope
        y, slope = y - _mean(y, weight), slope - _mean(slope, weight)
        among = np.linalg.pinv(np.diag(weight.sum(1)) - (weight / np.maximum(weight.sum(0), _LEAST)) @ weight.T)
        by_gain, crossed = (weight * y).sum(2), (weight * slope).sum(2)  # [3, V]
        up = (weight * slope * y).sum() - np.einsum("cv,vw,cw->", crossed, among, by_gain)
        down = (weight * slope**2).sum() - np.einsum("cv,vw,cw->", crossed, among, crossed)
        haze = max(0.0, float(up / max(down, _LEAST)))
        gain = ((by_gain - haze * crossed) @ among)[..., None]
        hazed = np.log(np.maximum(1 + haze * term, _LEAST))
        own = _mean(light - gain - hazed, weight)
        left = light - gain - hazed - own
        weight = kept / (1 + np.square(left / _OUTLIER).mean(0))
    return gain[..., 0].T, np.where(kept[..., None], left.transpose(1, 2, 0), np.nan)


def _linear(coded: Float64) -> Float64:
    """sRGB in [0, 1] to linear light, above its toe."""
    return np.asarray(((coded + 0.055) / 1.055) ** 2.4)


def _mean(values: Float64, weight: Float64) -> Float64:
    """Weighted mean over views of [..., V, P] → [..., 1, P]; 0 where nothing counts."""
    return np.asarray((weight * values).sum(-2, keepdims=True) / np.maximum(weight.sum(0), _LEAST))


def _shared(value: Float64) -> NDArray[np.bool_]:
    """[V, P]: the image sees the point, and another does."""
    seen = np.isfinite(value).all(2)
    return seen & (seen.sum(0) >= 2)


def _logs(image: NDArray[np.uint8], uv: Float32) -> tuple[Float64, Float64]:
    """Log linear colours [M, 3] and their spread [M] in 3 × 3 pixels; NaN where a pixel is clipped or dark."""
    height, width = image.shape[:2]
    column = uv[:, 0].astype(np.int64).clip(1, width - 2)
    row = uv[:, 1].astype(np.int64).clip(1, height - 2)
    cells = np.stack([image[row + y, column + x] for y in (-1, 0, 1) for x in (-1, 0, 1)]) / 255.0
    clipped = ((cells < _DARK) | (cells > _BRIGHT)).any((0, 2))
    light = np.log(_linear(cells.clip(_DARK, 1)))
    middle, spread = light.mean(0), light.std(0).mean(1)
    middle[clipped], spread[clipped] = np.nan, np.nan
    return middle, spread
