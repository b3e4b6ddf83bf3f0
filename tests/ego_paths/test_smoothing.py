"""Smooth curves: what comes through, and what is taken for jitter."""

from __future__ import annotations

import numpy as np
import pytest

from genre_tasks.ego_paths.smoothing import fit_smooth_curve


@pytest.mark.parametrize("times", [np.arange(40) * 0.1, np.array([0.0, 0.1, 0.5]), np.sort(np.random.rand(9))])
def test_parabolas_come_through(times: np.ndarray) -> None:
    values = np.stack([3 + 2 * times - 5 * times**2, np.full_like(times, 7.0)], axis=1)
    curve = fit_smooth_curve(times, values, 0.15)
    dense = np.linspace(times[0], times[-1], 50)
    assert np.allclose(curve.evaluate(dense)[:, 0], 3 + 2 * dense - 5 * dense**2, atol=1e-7)
    assert np.allclose(curve.evaluate(dense, 1), np.stack([2 - 10 * dense, 0 * dense], axis=1), atol=1e-4)


@pytest.mark.parametrize("period_in_scales", [3.0, 6.283, 12.0])
def test_waves_come_through_by_the_stated_factor(period_in_scales: float) -> None:
    scale = 0.5
    omega = 2 * np.pi / (period_in_scales * scale)
    times = np.arange(0, 40, 0.05)
    smooth = fit_smooth_curve(times, np.sin(omega * times)[:, None], scale).evaluate(times)[:, 0]
    middle = slice(200, 600)  # Away from the ends, where there is no wave to average over.
    factor = float(np.dot(smooth[middle], np.sin(omega * times)[middle]) / np.sum(np.sin(omega * times)[middle] ** 2))
    assert factor == pytest.approx(1 / (1 + (omega * scale) ** 6), abs=0.03)


def test_centimetres_of_jitter_are_no_acceleration() -> None:
    times = np.arange(60) * 0.1
    noise = 0.01 * np.random.default_rng(3).standard_normal((60, 1))
    differences = np.abs(np.diff(noise[:, 0], 2)).max() / 0.1**2
    smooth = np.abs(fit_smooth_curve(times, noise, 0.15).evaluate(times, 2)).max()
    assert differences > 2.0
    assert smooth < 0.5


def test_world_coordinates_of_millions_of_metres_lose_nothing() -> None:
    times = np.arange(40) * 0.1
    values = np.sin(times)[:, None]
    near = fit_smooth_curve(times, values, 0.15)
    far = fit_smooth_curve(times + 1.6e9, values + 5e6, 0.15)
    assert np.abs(far.evaluate(times + 1.6e9, 2) - near.evaluate(times, 2)).max() < 1e-3


def test_two_samples_are_a_line() -> None:
    curve = fit_smooth_curve(np.array([1.0, 1.1]), np.array([[0.0], [2.0]]), 0.15)
    assert np.allclose(curve.evaluate(np.array([1.0, 1.05, 1.1])), [[0.0], [1.0], [2.0]])


@pytest.mark.parametrize("times", [np.zeros(0), np.zeros(1), np.zeros(5)])
def test_too_few_samples_are_refused(times: np.ndarray) -> None:
    with pytest.raises((ValueError, IndexError)):
        fit_smooth_curve(times, np.zeros((len(times), 2)), 0.15)
