"""What several effects look at, each read or computed once: images, LiDAR returns in images, one point's colours."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from genre_tasks.logs.types import Camera, Float32, Float64
from genre_tasks.scene.chunk import Chunk, View
from genre_tasks.scene.coloring import visible
from genre_tasks.scene.geometry import path_distance
from genre_tasks.scene.images import decode_pixels
from genre_tasks.scene.projection import Projected, project

SAMPLES = 6000
"""Static points whose colours are compared between images."""

SAMPLE_RANGE_M = 40.0
"""Farther ones are a pixel among others: their colour is the neighbourhood's."""

_GAMMA, _ROUNDS, _FEW = 2.2, 6, 10
_DARK = 8.0 / 255
_BRIGHT = 247.0 / 255
"""Outside, a pixel is clipped or mostly noise, and its logarithm says nothing of the gain."""


@dataclass(frozen=True)
class Colours:
    """Log of linear colour of V images at P static points: ``value`` [V, P, 3], NaN where a view does not see it, or
    sees it clipped or dark.

    ``texture`` [V, P]: standard deviation of the same within 3 × 3 pixels, mean over channels.
    """

    views: tuple[View, ...]
    value: Float64
    texture: Float64


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
        texture = np.full(value.shape[:2], np.nan)
        for k, view in enumerate(self.sources):
            index, uv, depth = visible(points.positions, view)
            ours = (rank[index] >= 0) & (depth < SAMPLE_RANGE_M)
            image = self.pixels[view.camera, view.frame]
            at = rank[index[ours]]
            value[k, at], texture[k, at] = _logs(image, uv[ours])
        return Colours(self.sources, value, texture)

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
        """Log colour = the point's + the image's gain: by least squares, then by medians in turn against outliers.

        Least squares first: where images overlap in a chain, taking turns would need as many rounds as the chain's
        square. Haze lightens what is seen from afar and passes for gain: streets without any change have some 5 %.
        """
        kept = _shared(self.colours.value)
        value = np.where(kept[..., None], self.colours.value, np.nan)
        see = kept.astype(np.float64)
        each = see / np.maximum(see.sum(0), 1)
        rest = np.where(kept[..., None], value - _nanmean(value, 0), 0).sum(1)
        gain = np.linalg.pinv(np.diag(see.sum(1)) - each @ see.T, hermitian=True) @ rest
        for _ in range(_ROUNDS):
            left = value - gain[:, None]
            left -= _nanmean(left, 0)
            gain += np.stack([_nanmedian(v) for v in left])
        known = self.linked
        gain -= gain[known].mean(0) if known.any() else 0
        left = value - gain[:, None]
        return gain, left - _nanmean(left, 0)


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
    light = _GAMMA * np.log(cells.clip(_DARK, 1))
    middle, spread = light.mean(0), light.std(0).mean(1)
    middle[clipped], spread[clipped] = np.nan, np.nan
    return middle, spread


def _nanmean(values: Float64, axis: int) -> Float64:
    known = np.isfinite(values)
    return np.where(known, values, 0).sum(axis) / np.where(known.any(axis), known.sum(axis), np.nan)


def _nanmedian(values: Float64) -> Float64:
    """Over points, 0 where fewer than ten are known."""
    known = np.isfinite(values).all(1)
    return np.median(values[known], 0) if known.sum() >= _FEW else np.zeros(values.shape[1])
