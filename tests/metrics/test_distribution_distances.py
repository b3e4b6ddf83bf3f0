"""Fréchet and kernel distances of sets: values, hard cases, bias, intervals."""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor

from genre_tasks.errors import NonFiniteError
from genre_tasks.metrics.distribution_distances import frechet_distance, kernel_difference, kernel_distance


def gaussian(count: int, dimensions: int, seed: int, mean: float = 0.0, scale: float = 1.0) -> Tensor:
    generator = torch.Generator().manual_seed(seed)
    return mean + scale * torch.randn(count, dimensions, generator=generator)


def frames(count: int, each: int = 4) -> list[int]:
    return [i // each for i in range(count)]


def test_frechet_of_known_gaussians() -> None:
    """‖Δμ‖² + Σ (σ₁ − σ₂)² for covariances that commute: here D (1² + 1²)."""
    a, b = gaussian(20_000, 4, 1), gaussian(20_000, 4, 2, mean=1.0, scale=2.0)
    assert frechet_distance(a, b).value == pytest.approx(8.0, rel=0.03)


def test_frechet_agrees_with_a_matrix_square_root() -> None:
    """Against scipy's general square root, which has complex entries where rounding makes eigenvalues negative."""
    import numpy as np
    from scipy.linalg import sqrtm

    mix = gaussian(6, 6, 3).double()
    a, b = gaussian(80, 6, 4).double() @ mix, gaussian(90, 6, 5).double() + 0.3
    ca, cb = np.cov(a.numpy().T), np.cov(b.numpy().T)
    root = sqrtm(ca @ cb).real
    expected = ((a.mean(0) - b.mean(0)) ** 2).sum().item() + np.trace(ca + cb - 2 * root)
    assert frechet_distance(a, b).value == pytest.approx(expected, rel=1e-8)


@pytest.mark.parametrize(("count", "dimensions"), [(2, 1280), (10, 64), (40, 1280), (200, 100), (5, 3)])
def test_frechet_of_identical_sets_is_zero(count: int, dimensions: int) -> None:
    x = gaussian(count, dimensions, 1)
    result = frechet_distance(x, x.clone())
    assert 0 <= result.value < 1e-9 * dimensions
    assert (result.n, result.n_reference) == (count, count)


def test_frechet_of_degenerate_sets() -> None:
    """Constant features (zero covariance), and fewer images than dimensions, are finite and not negative."""
    constant = torch.ones(5, 1280)
    assert frechet_distance(constant, constant).value == 0
    shifted = frechet_distance(constant, gaussian(7, 1280, 2))
    assert math.isfinite(shifted.value) and shifted.value > 0
    low_rank = gaussian(9, 2, 3) @ gaussian(2, 64, 4)
    assert 0 <= frechet_distance(low_rank, low_rank[:4]).value < math.inf


def test_one_image_has_no_distance() -> None:
    one, many = gaussian(1, 8, 1), gaussian(9, 8, 2)
    assert frechet_distance(one, many) is None and frechet_distance(many, one) is None
    assert kernel_distance(one, many, [0], frames(9)) is None
    assert kernel_distance(many, one, frames(9), [0]) is None


def test_the_projection_is_the_same_in_every_call_and_keeps_lengths() -> None:
    a, b = gaussian(30, 1280, 1), gaussian(30, 1280, 2, mean=0.5)
    assert frechet_distance(a, b).value == frechet_distance(a, b).value
    far = frechet_distance(torch.zeros(2, 1280), torch.ones(2, 1280)).value
    assert 0 < far <= 1280  # an orthonormal projection shortens


def test_kernel_is_the_textbook_estimate() -> None:
    x, y = gaussian(6, 5, 1).double(), gaussian(7, 5, 2, mean=0.4).double()

    def kernel(a: Tensor, b: Tensor) -> float:
        return ((a @ b).item() / 5 + 1) ** 3

    expected = sum(kernel(x[i], x[j]) for i in range(6) for j in range(6) if i != j) / 30
    expected += sum(kernel(y[i], y[j]) for i in range(7) for j in range(7) if i != j) / 42
    expected -= 2 * sum(kernel(x[i], y[j]) for i in range(6) for j in range(7)) / 42
    result = kernel_distance(x, y, frames(6, 2), frames(7, 2), bootstrap=20)
    assert result.value == pytest.approx(expected, rel=1e-12)
    assert (result.n, result.n_reference) == (6, 7)


def test_kernel_is_unbiased_and_frechet_is_not() -> None:
    """Two samples of one distribution: the kernel distance averages to 0, the Fréchet distance falls with N."""
    kernel, frechet = {}, {}
    for count in (16, 64):
        pairs = [(gaussian(count, 32, 2 * s), gaussian(count, 32, 2 * s + 1)) for s in range(60)]
        values = torch.tensor([kernel_distance(a, b, range(count), range(count), 0).value for a, b in pairs])
        kernel[count] = (values.mean() / (values.std() / 60**0.5)).item()
        frechet[count] = sum(frechet_distance(a, b).value for a, b in pairs) / 60
    assert abs(kernel[16]) < 3 and abs(kernel[64]) < 3
    assert frechet[16] > 2 * frechet[64] > 1


def test_interval_covers_the_truth_about_as_often_as_it_says() -> None:
    """Frames with a common offset: an interval over images would be far too narrow."""

    def sample(seed: int, mean: float) -> Tensor:
        offset = gaussian(20, 8, seed, scale=0.5).repeat_interleave(4, 0)
        return offset + gaussian(80, 8, seed + 10_000, mean=mean, scale=0.3)

    results = [
        kernel_distance(sample(2 * s, 0.4), sample(2 * s + 1, 0.0), frames(80), frames(80), 100) for s in range(60)
    ]
    truth = sum(r.value for r in results) / 60
    covered = sum(r.low <= truth <= r.high for r in results)
    assert 48 <= covered <= 60


def test_difference_is_paired() -> None:
    """The interval of a small, consistent difference excludes 0 although those of the two distances overlap."""
    reference = gaussian(80, 16, 1)
    base = reference.roll(7, 0) + gaussian(80, 16, 2, scale=0.3) + 0.5
    worse = base + 0.08
    first = kernel_distance(base, reference, frames(80), frames(80))
    second = kernel_distance(worse, reference, frames(80), frames(80))
    difference = kernel_difference(base, worse, reference, frames(80), frames(80), frames(80))
    assert difference.value == pytest.approx(first.value - second.value, abs=1e-12)
    assert first.high > second.low
    assert difference.low <= difference.value <= difference.high < 0
    same = kernel_difference(base, base, reference, frames(80), frames(80), frames(80))
    assert same.value == same.low == same.high == 0


def test_seeded_and_the_same_at_any_thread_count() -> None:
    a, b = gaussian(40, 1280, 1), gaussian(30, 1280, 2, mean=0.1)
    before, results = torch.get_num_threads(), []
    try:
        for threads in (1, 4):
            torch.set_num_threads(threads)
            results.append((frechet_distance(a, b), kernel_distance(a, b, frames(40), frames(30), 50, seed=3)))
    finally:
        torch.set_num_threads(before)
    assert results[0] == results[1]
    assert kernel_distance(a, b, frames(40), frames(30), 50, seed=4).low != results[0][1].low


def test_no_interval_without_resamples_or_with_one_frame() -> None:
    a, b = gaussian(6, 8, 1), gaussian(6, 8, 2)
    for result in (kernel_distance(a, b, frames(6), frames(6), 0), kernel_distance(a, b, [0] * 6, [0] * 6, 50)):
        assert result.low is None and result.high is None and math.isfinite(result.value)


def test_faults() -> None:
    with pytest.raises(ValueError, match=r"expected features \[N, D\]"):
        frechet_distance(torch.zeros(3, 4), torch.zeros(3, 5))
    with pytest.raises(ValueError, match="expected one frame for each"):
        kernel_distance(torch.zeros(3, 4), torch.zeros(3, 4), [0], [0, 1, 2])
    broken = torch.zeros(3, 4)
    broken[1, 2] = math.inf
    with pytest.raises(NonFiniteError, match="features holds 1 non-finite"):
        frechet_distance(broken, torch.zeros(3, 4))


def test_resamples_of_few_frames_are_not_biased() -> None:
    """Images of a frame are alike: resamples that overweight their pairs would leave the estimate out."""
    cameras = gaussian(6, 64, 99, scale=0.5).repeat(5, 1)
    outside = 0
    for seed in range(30):
        street = gaussian(5, 64, seed, scale=0.3).repeat_interleave(6, 0)
        reference = cameras + street + gaussian(30, 64, seed + 1000, scale=0.5)
        x = 0.9 * reference + gaussian(30, 64, seed + 2000, scale=0.15) + 0.05
        result = kernel_distance(x, reference, frames(30, 6), frames(30, 6), 100, seed)
        outside += not result.low <= result.value <= result.high
    assert outside <= 3
