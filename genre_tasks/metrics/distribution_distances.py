"""Distances between two sets of images, on pooled features: a Fréchet distance and a kernel distance.

They are built as FID (Heusel et al. 2017) and KID (Bińkowski et al. 2018) are, but on another network's features, so
that they cannot be compared with published numbers. With the few hundred images of a chunk a Fréchet distance in 1280
dimensions is mostly bias. It is therefore computed on a fixed projection to 64 dimensions, still depends on N, and is
to be compared at equal N only. The kernel distance is unbiased at any N: claims are made on it.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import lru_cache, partial
from typing import TypeVar

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from genre_tasks.checks import check_finite
from genre_tasks.threads import map_single_threaded

PROJECTED_DIMENSIONS = 64
"""Dimensions of the features that the Fréchet distance is computed in."""

_PROJECTION_SEED = 64
_REDRAWS = 100
"""Resamples that may be drawn again because they hold fewer than two images."""

Value = TypeVar("Value")


@dataclass(frozen=True)
class SetDistance:
    """A distance between a set of images and a reference set.

    Attributes:
        value: the distance.
        n: images of the set.
        n_reference: images of the reference.
        low: lower end of the central 95 % of the bootstrap over frames; ``None`` where none was made.
        high: upper end of it.
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
    """Computes the Fréchet distance of the Gaussians fitted to two sets, after a projection to 64 dimensions.

    It is ``‖μ₁ − μ₂‖² + tr C₁ + tr C₂ − 2 tr (C₁C₂)^½``. The last trace is the sum of the singular values of
    ``C₁^½ C₂^½``, which is real for any covariances, singular ones (N ≤ 64) included.

    Args:
        features: pooled features of the images to judge.
        reference: pooled features of real images.

    Returns:
        A distance of at least 0 without an interval; ``None`` with fewer than two images in a set, as there is no
        covariance.

    Raises:
        ValueError: the shapes do not fit.
        NonFiniteError: a feature is NaN or infinite.

    >>> square = torch.tensor([[0.0, 0.0], [0.0, 1.0], [1.0, 0.0], [1.0, 1.0]])
    >>> round(frechet_distance(square + 2.0, square).value, 6)
    8.0
    """
    _check_features(features, reference)
    if len(features) < 2 or len(reference) < 2:
        return None

    def distance(pair: tuple[Tensor, Tensor]) -> float:
        (mean_a, root_a), (mean_b, root_b) = (_fit_gaussian(_project(x)) for x in pair)
        # The squared entries of a symmetric root sum up to the trace of the covariance.
        traces = root_a.square().sum() + root_b.square().sum()
        cross = torch.linalg.svdvals(root_a @ root_b).sum()
        return float((mean_a - mean_b).square().sum() + traces - 2 * cross)

    value = _on_one_thread(distance, (features.double().cpu(), reference.double().cpu()))
    # Rounding can take the distance of a set from itself below 0.
    return SetDistance(max(value, 0.0), len(features), len(reference))


def kernel_distance(
    features: Tensor,  # [N, D]
    reference: Tensor,  # [M, D]
    frames: Sequence[int],  # [N]
    reference_frames: Sequence[int],  # [M]
    bootstrap: int = 200,
    seed: int = 0,
) -> SetDistance | None:
    """Computes the squared maximum mean discrepancy with the kernel ``(x·y / D + 1)³``, unbiased.

    The interval comes from resamples of whole frames, drawn jointly for both sets, because images of one frame are not
    independent.

    Args:
        features: pooled features of the images to judge.
        reference: pooled features of real images.
        frames: the frame of each image; give frames of different chunks different numbers.
        reference_frames: the same for the reference.
        bootstrap: number of resamples; 0, or a single frame, gives no interval.
        seed: of the resampling.

    Returns:
        A distance that may be below 0; ``None`` with fewer than two images in a set.

    Raises:
        ValueError: the shapes do not fit.
        NonFiniteError: a feature is NaN or infinite.
    """
    return _kernel_statistic([features], reference, [frames], reference_frames, bootstrap, seed)


def kernel_difference(
    features: Tensor,  # [N, D]
    other: Tensor,  # [N', D]
    reference: Tensor,  # [M, D]
    frames: Sequence[int],  # [N]
    other_frames: Sequence[int],  # [N']
    reference_frames: Sequence[int],  # [M]
    bootstrap: int = 200,
    seed: int = 0,
) -> SetDistance | None:
    """Compares two methods: ``kernel_distance(features) − kernel_distance(other)`` with a paired interval.

    The claim that ``features`` are nearer to the reference holds where ``high < 0``. Each resample draws the same
    frames for both methods and for the reference.

    Args:
        features: pooled features of the first method's images.
        other: pooled features of the second method's images.
        reference: pooled features of real images.
        frames: the frame of each of the first method's images.
        other_frames: the same for the second method.
        reference_frames: the same for the reference.
        bootstrap: number of resamples.
        seed: of the resampling.

    Returns:
        The difference with its interval, and ``None`` as in :func:`kernel_distance`.

    Raises:
        ValueError: the shapes do not fit.
        NonFiniteError: a feature is NaN or infinite.
    """
    _check_features(other, reference)
    return _kernel_statistic([features, other], reference, [frames, other_frames], reference_frames, bootstrap, seed)


def _kernel_statistic(
    sets: list[Tensor],
    reference: Tensor,
    frames: list[Sequence[int]],
    reference_frames: Sequence[int],
    bootstrap: int,
    seed: int,
) -> SetDistance | None:
    """The distance of the first set, less that of the second if there is one."""
    for features, numbers in zip([*sets, reference], [*frames, reference_frames], strict=True):
        _check_features(features, reference)
        if len(numbers) != len(features):
            raise ValueError(f"expected one frame for each of {len(features)} images, got {len(numbers)}")
    if min(len(x) for x in [*sets, reference]) < 2:
        return None
    # Frames of all sets: a resample draws the same ones everywhere, which makes differences paired.
    known = sorted({int(f) for numbers in [*frames, reference_frames] for f in numbers})
    blocks = [
        _on_one_thread(
            partial(_KernelBlocks.from_features, x_frames=set_frames, y_frames=reference_frames, known=known),
            (features.double().cpu(), reference.double().cpu()),
        )
        for features, set_frames in zip(sets, frames, strict=True)
    ]

    def statistic(weights: NDArray[np.float64], other_frames_weight: float = 1.0) -> float | None:
        values = [v for b in blocks if (v := b.distance(weights, other_frames_weight)) is not None]
        return values[0] - sum(values[1:]) if len(values) == len(blocks) else None

    # Each frame once is the estimate itself.
    value = statistic(np.ones(len(known)))
    # A resample holds a frame once on average, but two different frames together only (F − 1) / F times: without this
    # weight, pairs of one frame, which are the more similar ones, would count for too much in every resample.
    balance = len(known) / max(len(known) - 1, 1)
    low, high = _bootstrap_interval(partial(statistic, other_frames_weight=balance), len(known), bootstrap, seed)
    return None if value is None else SetDistance(value, len(sets[0]), len(reference), low, high)


@dataclass(frozen=True)
class _KernelBlocks:
    """Sums of the kernel over pairs of images, by pair of frames, and the numbers of these pairs; all [F, F].

    With them a resample costs a weighted sum over frames instead of one over images.
    """

    within: NDArray[np.float64]
    within_pairs: NDArray[np.float64]
    across: NDArray[np.float64]
    across_pairs: NDArray[np.float64]
    reference: NDArray[np.float64]
    reference_pairs: NDArray[np.float64]

    @staticmethod
    def from_features(
        sets: tuple[Tensor, Tensor], x_frames: Sequence[int], y_frames: Sequence[int], known: Sequence[int]
    ) -> _KernelBlocks:
        """Sums over the pairs of a set with itself, with the reference, and of the reference with itself."""
        x, y = sets
        x_members = _frame_membership(x_frames, known)
        y_members = _frame_membership(y_frames, known)
        blocks = []
        for a, b, a_members, b_members in (
            (x, x, x_members, x_members),
            (x, y, x_members, y_members),
            (y, y, y_members, y_members),
        ):
            # KID's polynomial kernel of degree 3.
            kernel = (a @ b.T / a.shape[1] + 1.0) ** 3
            pairs = torch.ones_like(kernel)
            if a is b:
                # An image is no pair with itself: leaving it out makes the estimate unbiased.
                kernel = kernel.fill_diagonal_(0.0)
                pairs = pairs.fill_diagonal_(0.0)
            blocks.append((a_members @ kernel @ b_members.T).numpy())
            blocks.append((a_members @ pairs @ b_members.T).numpy())
        return _KernelBlocks(*blocks)

    def distance(self, weights: NDArray[np.float64], other_frames_weight: float = 1.0) -> float | None:
        """The estimate with frame f drawn ``weights[f]`` times; ``None`` if a set has no pair of images.

        Pairs of images of two different frames count ``other_frames_weight`` times as much as those of one frame.
        """
        # Pairs between two copies of one frame are left out, as an image's pair with itself is: with them, every
        # resample would be biased towards similar pairs.
        pairs = other_frames_weight * np.outer(weights, weights)
        np.fill_diagonal(pairs, weights)
        means = []
        for sums, counts in (
            (self.within, self.within_pairs),
            (self.reference, self.reference_pairs),
            (self.across, self.across_pairs),
        ):
            count = float((pairs * counts).sum())
            # A resample can hold a single image of a set, which makes no pair.
            if count == 0:
                return None
            means.append(float((pairs * sums).sum()) / count)
        return means[0] + means[1] - 2 * means[2]


def _frame_membership(frames: Sequence[int], known: Sequence[int]) -> Tensor:
    """[F, N] float64: 1 where an image is of a known frame."""
    return (torch.tensor(known)[:, None] == torch.tensor(list(frames))).double()


def _bootstrap_interval(
    statistic: Callable[[NDArray[np.float64]], float | None], frames: int, bootstrap: int, seed: int
) -> tuple[float | None, float | None]:
    """2.5 % and 97.5 % points over resamples; draws for which the statistic is undefined are drawn again."""
    if frames < 2 or bootstrap < 1:
        return None, None
    # Frames are resampled, not images: cameras of one frame see the same street.
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


def _fit_gaussian(x: Tensor) -> tuple[Tensor, Tensor]:
    """Mean [D] and the symmetric root [D, D] of the covariance of rows."""
    mean = x.mean(0)
    centred = x - mean
    values, vectors = torch.linalg.eigh(centred.T @ centred / (len(x) - 1))
    # Rounding makes eigenvalues of singular covariances slightly negative.
    return mean, (vectors * values.clamp_min(0).sqrt()) @ vectors.T


def _project(x: Tensor) -> Tensor:
    # Fewer dimensions than the projection has need none.
    return x if x.shape[1] <= PROJECTED_DIMENSIONS else x @ _projection(x.shape[1])


@lru_cache(maxsize=2)
def _projection(dimensions: int) -> Tensor:
    """[D, 64] float64 with orthonormal columns, the same in every run."""
    generator = torch.Generator().manual_seed(_PROJECTION_SEED)
    # Random and orthonormal: it shortens no direction more than another on average.
    noise = torch.randn((dimensions, PROJECTED_DIMENSIONS), generator=generator, dtype=torch.float64)
    return torch.linalg.qr(noise).Q


def _on_one_thread(function: Callable[[tuple[Tensor, Tensor]], Value], pair: tuple[Tensor, Tensor]) -> Value:
    # The last bits of matrix products and decompositions depend on the number of threads.
    return map_single_threaded(function, [pair])[0]


def _check_features(features: Tensor, reference: Tensor) -> None:
    if features.ndim != 2 or reference.ndim != 2 or features.shape[1] != reference.shape[1]:
        raise ValueError(f"expected features [N, D] and [M, D], got {list(features.shape)} and {list(reference.shape)}")
    check_finite(features, "features", "evaluate")
    check_finite(reference, "reference features", "evaluate")
