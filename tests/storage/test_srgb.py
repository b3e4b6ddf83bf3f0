"""The border between sRGB and scene-linear light."""

from __future__ import annotations

import numpy as np
import pytest

from genre_tasks.errors import NonFiniteError
from storage.srgb import ROUNDING_BOUND, from_linear_half, linear_to_srgb, srgb_to_linear, to_linear_half


def test_known_values() -> None:
    display = np.array([0.0, 0.04045, 0.5, 1.0, -0.5])
    assert np.allclose(srgb_to_linear(display), [0, 0.0031308, 0.21404114, 1, -0.21404114], atol=1e-7)


def test_inverse_in_double_precision() -> None:
    # The standard's two thresholds meet only to about 1e-8.
    x = np.linspace(-1.5, 4, 200_001)
    assert np.abs(linear_to_srgb(srgb_to_linear(x)) - x).max() < 1e-7


def test_opaque_rounding_is_within_the_bound_for_every_level() -> None:
    x = np.linspace(0, 1, 3 * 70_000, dtype=np.float32).reshape(100, 700, 3)
    error = np.abs(from_linear_half(to_linear_half(x, None, "x"), None) - x).max()
    assert 1e-5 < error < 2.5e-4 < ROUNDING_BOUND


def test_premultiplied_rounding_is_within_the_bound() -> None:
    rng = np.random.default_rng(0)
    alpha = (10 ** rng.uniform(-12, 0, (300, 700))).astype(np.float32)
    alpha[:100] = rng.random((100, 700))
    color = rng.random((300, 700, 3)).astype(np.float32) * alpha[..., None]
    back = from_linear_half(to_linear_half(color, alpha, "x"), alpha)
    assert np.abs(back - color).max() < 2.5e-4


def test_eight_bit_levels_survive() -> None:
    x = np.repeat(np.arange(256)[:, None, None], 3, 2).astype(np.float32) / 255
    back = from_linear_half(to_linear_half(x, None, "x"), None)
    assert np.array_equal(np.round(back * 255), np.round(x * 255))


def test_nothing_where_alpha_is_zero() -> None:
    alpha = np.zeros((2, 2), np.float32)
    light = to_linear_half(np.full((2, 2, 3), 0.3, np.float32), alpha, "x")
    assert not light.any() and not from_linear_half(light, alpha).any()


def test_linear_light_is_premultiplied_after_linearising() -> None:
    light = to_linear_half(np.full((1, 1, 3), 0.25, np.float32), np.full((1, 1), 0.5, np.float32), "x")
    assert light[0, 0, 0] == np.float16(0.5 * 0.21404114)


@pytest.mark.parametrize("bad", [np.nan, np.inf, 200.0])
def test_non_finite_and_overflow_are_named(bad: float) -> None:
    x = np.zeros((2, 3, 3), np.float32)
    x[1, 2, 0] = bad
    with pytest.raises(NonFiniteError, match="my view") as caught:
        to_linear_half(x, None, "my view")
    assert caught.value.first_index == (1, 2, 0) and caught.value.count == 1
