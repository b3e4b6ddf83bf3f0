"""Distances between two sets of images, on pooled features: a Fréchet distance and a kernel distance.

They are built as FID (Heusel et al. 2017) and KID (Bińkowski et al. 2018) are, on another network's features, hence
not comparable to published numbers. With the few hundred images of a chunk a Fréchet distance in 1280 dimensions is
mostly bias; it is taken on a fixed projection to 64 dimensions, still depends on N, and is to be compared at equal N
only. The kernel distance is unbiased at any N: claims are made on it.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import lru_cache, partial
from typing import TypeVar

import numpy as np
import torch
from torch import Tensor

from genre_tasks.errors import NonFiniteError
from genre_tasks.threads import map_single_threaded

PROJECTED_DIMENSIONS = 64
_PROJECTION_SEED = 64
_REDRAWS = 100

Value = TypeVar("Value")


@dataclass(frozen=True)
class SetDistance:
    """A distance between a test set of ``n`` images and a reference of ``n_reference``.

    ``low`` and ``high`` bound the central 95 % of the bootstrap over frames; ``None`` where none was made.
    """

    value: float
    n: int
    n_reference: int
    low: float | None = None
    high: float | None = None


def frechet_distance(
    features: Tensor,  # [N, D]
    reference: Tensor,  # [M, D]
) -> SetDistance | None:
    """Fréchet distance of the Gaussians fitted to both sets, after a fixed projection to 64 dimensions; ≥ 0.

    ``‖μ₁ − μ₂‖² + tr C₁ + tr C₂ − 2 tr (C₁C₂)^½``. The last trace is the sum of the singular values of ``C₁^½ C₂^½``,
    which is real for any covariances, singular ones (N ≤ 64) included. ``None`` with fewer than two images in a set:
    there is no covariance.

    Raises:
        ValueError: the shapes do not fit. NonFiniteError: a feature is not finite.
    """
    _check(features, reference)
    if len(features) < 2 or len(reference) < 2:
        return None

    def distance(pair: tuple[Tensor, Tensor]) -> float:
        (mean_a, root_a), (mean_b, root_b) = (_gaussian(_project(x)) for x in pair)
        traces = root_a.square().sum() + root_b.square().sum()
        cross = torch.linalg.svdvals(root_a @ root_b).sum()
        return float((mean_a - mean_b).square().sum() + traces - 2 * cross)

    value = _on_one_thread(distance, (features.double().cpu(), reference.double().cpu()))
    return SetDistance(max(value, 0.0), len(features), len(reference))


def kernel_distance(
    features: Tensor,  # [N, D]
    reference: Tensor,  # [M, D]
    frames: Sequence[int],  # [N]
    reference_frames: Sequence[int],  # [M]
    bootstrap: int = 200,
    seed: int = 0,
) -> SetDistance | None:
    """Squared maximum mean discrepancy with the kernel ``(x·y / D + 1)³``, unbiased (it may be below 0).

    The interval comes from ``bootstrap`` resamples of whole frames, drawn jointly for both sets: images of one frame
    are not independent. ``None`` with fewer than two images in a set.

    Args:
        frames, reference_frames: the frame of each image; give frames of different chunks different numbers.
        bootstrap: resamples; no interval with 0, or where there is only one frame.
        seed: of the resampling.

    Raises:
        ValueError: the shapes do not fit. NonFiniteError: a feature is not finite.
    """
    return _kernel([features], reference, [frames], reference_frames, bootstrap, seed)


def kernel_difference(
    features: Tensor,  # [N, D]
    other: Tensor,  # [N', D]
    reference: Tensor,  # [M, D]
    frames: Sequence[int],
    other_frames: Sequence[int],
    reference_frames: Sequence[int],
    bootstrap: int = 200,
    seed: int = 0,
) -> SetDistance | None:
    """``kernel_distance(features) − kernel_distance(other)``, with a paired interval: a claim that ``features`` are
    nearer to the reference holds where ``high < 0``.

    Each resample draws the same frames for both methods and the reference. Arguments, ``None`` and errors as in
    :func:`kernel_distance`.
    """
    _check(other, reference)
    return _kernel([features, other], reference, [frames, other_frames], reference_frames, bootstrap, seed)


def _kernel(
    sets: list[Tensor],
    reference: Tensor,
    frames: list[Sequence[int]],
    reference_frames: Sequence[int],
    bootstrap: int,
    seed: int,
) -> SetDistance | None:
    """The distance of the first set, less that of the second if there is one."""
    for features, numbers in zip([*sets, reference], [*frames, reference_frames], strict=True):
        _check(features, reference)
        if len(numbers) != len(features):
            raise ValueError(f"expected one frame for each of {len(features)} images, got {len(numbers)}")
    if min(len(x) for x in [*sets, reference]) < 2:
        return None
    known = sorted({int(f) for numbers in [*frames, reference_frames] for f in numbers})
    blocks = [
        _on_one_thread(
            partial(_Blocks.of, x_frames=own, y_frames=reference_frames, known=known),
            (features.double().cpu(), reference.double().cpu()),
        )
        for features, own in zip(sets, frames, strict=True)
    ]

    def statistic(weights: np.ndarray) -> float | None:
        values = [v for b in blocks if (v := b.distance(weights)) is not None]
        return values[0] - sum(values[1:]) if len(values) == len(blocks) else None

    value = statistic(np.ones(len(known)))
    low, high = _interval(statistic, len(known), bootstrap, seed)
    return None if value is None else SetDistance(value, len(sets[0]), len(reference), low, high)


@dataclass(frozen=True)
class _Blocks:
    """Sums of the kernel over pairs of images, by pair of frames, and the numbers of those pairs; all [F, F]."""

    within: np.ndarray
    within_pairs: np.ndarray
    across: np.ndarray
    across_pairs: np.ndarray
    reference: np.ndarray
    reference_pairs: np.ndarray

    @staticmethod
    def of(
        sets: tuple[Tensor, Tensor], x_frames: Sequence[int], y_frames: Sequence[int], known: Sequence[int]
    ) -> _Blocks:
        x, y = sets
        xs, ys = ((torch.tensor(known)[:, None] == torch.tensor(list(f))).double() for f in (x_frames, y_frames))
        parts = []
        for a, b, left, right in ((x, x, xs, xs), (x, y, xs, ys), (y, y, ys, ys)):
            kernel = (a @ b.T / a.shape[1] + 1.0) ** 3
            pairs = torch.ones_like(kernel)
            if a is b:  # an image is no pair with itself: that is what makes the estimate unbiased
                kernel, pairs = kernel.fill_diagonal_(0.0), pairs.fill_diagonal_(0.0)
            parts += [(left @ kernel @ right.T).numpy(), (left @ pairs @ right.T).numpy()]
        return _Blocks(*parts)

    def distance(self, weights: np.ndarray) -> float | None:
        """The unbiased estimate with frame f drawn ``weights[f]`` times; ``None`` if a set has no pair of images.

        Pairs between two copies of one frame are left out, as an image's pair with itself is: with them, every
        resample would be biased towards similar pairs.
        """
        pairs = np.outer(weights, weights)
        np.fill_diagonal(pairs, weights)
        means = []
        for sums, counts in (
            (self.within, self.within_pairs),
            (self.reference, self.reference_pairs),
            (self.across, self.across_pairs),
        ):
            count = float((pairs * counts).sum())
            if count == 0:
                return None
            means.append(float((pairs * sums).sum()) / count)
        return means[0] + means[1] - 2 * means[2]


def _interval(
    statistic: Callable[[np.ndarray], float | None], frames: int, bootstrap: int, seed: int
) -> tuple[float | None, float | None]:
    """2.5 % and 97.5 % points over resamples; draws for which the statistic is undefined are drawn again."""
    if frames < 2 or bootstrap < 1:
        return None, None
    generator = np.random.default_rng(seed)
    values: list[float] = []
    for _ in range(bootstrap + _REDRAWS):
        weights = np.bincount(generator.integers(frames, size=frames), minlength=frames).astype(np.float64)
        value = statistic(weights)
        if value is not None:
            values.append(value)
        if len(values) == bootstrap:
            low, high = np.quantile(values, [0.025, 0.975])
            return float(low), float(high)
    return None, None


def _gaussian(x: Tensor) -> tuple[Tensor, Tensor]:
    """Mean [D] and the symmetric root [D, D] of the covariance of rows."""
    mean = x.mean(0)
    centred = x - mean
    values, vectors = torch.linalg.eigh(centred.T @ centred / (len(x) - 1))
    return mean, (vectors * values.clamp_min(0).sqrt()) @ vectors.T


def _project(x: Tensor) -> Tensor:
    return x if x.shape[1] <= PROJECTED_DIMENSIONS else x @ _projection(x.shape[1])


@lru_cache(maxsize=2)
def _projection(dimensions: int) -> Tensor:
    """[D, 64] float64 with orthonormal columns, the same in every run."""
    generator = torch.Generator().manual_seed(_PROJECTION_SEED)
    noise = torch.randn((dimensions, PROJECTED_DIMENSIONS), generator=generator, dtype=torch.float64)
    return torch.linalg.qr(noise).Q


def _on_one_thread(function: Callable[[tuple[Tensor, Tensor]], Value], pair: tuple[Tensor, Tensor]) -> Value:
    """Matrix products and decompositions whose last bits do not depend on the number of threads."""
    return map_single_threaded(function, [pair])[0]


def _check(features: Tensor, reference: Tensor) -> None:
    if features.ndim != 2 or reference.ndim != 2 or features.shape[1] != reference.shape[1]:
        raise ValueError(f"expected features [N, D] and [M, D], got {list(features.shape)} and {list(reference.shape)}")
    for name, tensor in (("features", features), ("reference features", reference)):
        bad = torch.nonzero(~torch.isfinite(tensor))
        if len(bad):
            raise NonFiniteError("evaluate", name, len(bad), tuple(bad[0].tolist()))
