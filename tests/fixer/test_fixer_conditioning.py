"""Holes, what is told and what is left out, and the bound on colour shift (hard case 37)."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from genre_tasks.fixer.conditioning import bound_colour_shift, build_conditions, fill_holes
from genre_tasks.fixer.inputs import FixerInputs, depth_gap, mask_inputs
from genre_tasks.fixer.network import HINT_CHANNELS, INPUTS
from genre_tasks.fixer.pairs import INPUT_NAMES
from tests.fixer.conftest import random_views


def test_an_opaque_render_is_not_touched():
    color = torch.rand(2, 3, 9, 14)
    one, zero = torch.ones(2, 1, 9, 14), torch.zeros(2, 1, 9, 14)
    assert torch.equal(fill_holes(color, one, torch.rand(2, 3, 9, 14) * 0, zero), color)


def test_holes_take_the_lidar_map_and_then_the_surroundings():
    red, green = torch.tensor([0.8, 0.1, 0.1]), torch.tensor([0.1, 0.7, 0.2])
    color, alpha = torch.zeros(1, 3, 16, 24), torch.zeros(1, 1, 16, 24)
    lidar, lidar_alpha = torch.zeros(1, 3, 16, 24), torch.zeros(1, 1, 16, 24)
    color[..., :8], alpha[..., :8] = red[:, None, None], 1
    lidar[..., 4:12], lidar_alpha[..., 4:12] = green[:, None, None], 1
    out = fill_holes(color, alpha, lidar, lidar_alpha)
    torch.testing.assert_close(out[0, :, 5, 4], red)
    torch.testing.assert_close(out[0, :, 5, 9], green)
    torch.testing.assert_close(out[0, :, 5, 13], green, atol=0.05, rtol=0)
    assert out.sum(1).min() > 0.5


def test_nothing_drawn_is_black_and_finite():
    zero3, zero1 = torch.zeros(1, 3, 5, 7), torch.zeros(1, 1, 5, 7)
    assert torch.equal(fill_holes(zero3, zero1, zero3, zero1), zero3)


def mean(image: torch.Tensor, alpha: torch.Tensor) -> torch.Tensor:
    inside = (alpha > 0.5).float()
    return (image * inside).sum((2, 3)) / inside.sum((2, 3))


@pytest.mark.parametrize("shift", [0.2, -0.2, 0.9, -0.9])
def test_colour_shift_is_brought_back_to_the_bound(shift):
    render, alpha = torch.rand(2, 3, 12, 18), torch.rand(2, 1, 12, 18)
    out = bound_colour_shift(render + shift, render, alpha, 0.03)
    change = mean(out, alpha) - mean(render, alpha)
    assert change.abs().max() <= 0.03 + 1e-5
    assert (change.sign() == np.sign(shift)).all()
    assert out.min() >= 0 and out.max() <= 1


def test_small_changes_are_left_as_they_are():
    render, alpha = torch.rand(1, 3, 12, 18) * 0.8 + 0.1, torch.ones(1, 1, 12, 18)
    fixed = render + 0.09 * (torch.rand(1, 3, 12, 18) - 0.5)
    assert torch.equal(bound_colour_shift(fixed, render, alpha, 0.03), fixed)


def test_without_opaque_pixels_nothing_is_corrected():
    fixed = torch.rand(1, 3, 4, 4)
    assert torch.equal(bound_colour_shift(fixed, torch.zeros(1, 3, 4, 4), torch.zeros(1, 1, 4, 4)), fixed)


def test_agreement_and_sharpness_are_told():
    sharp = torch.rand(1, 3, 16, 24)
    one, zero = torch.ones(1, 1, 16, 24), torch.zeros(1, 1, 16, 24)
    views = FixerInputs(
        sharp * 0 + 0.5, one, sharp * 0, zero, sharp, sharp, one, one / 8, sharp * 0, zero, zero, one / 2
    )
    hints = build_conditions(views).hints
    assert hints.shape == (1, HINT_CHANNELS, 16, 24)
    lidar, warp, lidar_warp, render_sharp, warp_sharp, lidar_warp_sharp = hints[0, 10:16]
    assert not lidar.any() and not lidar_warp.any()  # nothing there, nothing that disagrees
    assert warp.mean() > 0.1 and warp_sharp.mean() > 2
    assert not render_sharp.any() and not lidar_warp_sharp.any()
    assert hints[0, 16:].flatten(1).mean(1).tolist() == [0.5, 0.0, 0.5]  # spreads, and how far the depths are apart


def test_what_a_fixer_is_not_given_is_blank():
    views = random_views(2, 16, 24)
    alone = mask_inputs(views, ("render",))
    kept = {name for name in INPUT_NAMES if torch.equal(getattr(alone, name), getattr(views, name))}
    assert kept == {"color", "alpha"}
    assert all(not getattr(alone, name).any() for name in set(INPUT_NAMES) - kept)
    pair = mask_inputs(views, ("reference", "lidar"))
    assert not pair.color.any() and not pair.warped.any() and torch.equal(pair.lidar_warped, views.lidar_warped)
    assert not mask_inputs(views, ("render", "reference")).lidar_warped.any()
    assert mask_inputs(views, INPUTS) == views


def test_depths_that_differ_are_told_where_both_are_known():
    one = torch.ones(1, 1, 4, 6)
    lidar_alpha = one.clone()
    lidar_alpha[..., 0] = 0.3
    gap = depth_gap(10 * one, one, 11 * one, lidar_alpha)
    assert not gap[..., 0].any()
    torch.testing.assert_close(gap[..., 1:], 4 * (one * 1.1).log()[..., 1:])
    assert depth_gap(10 * one, one, 30 * one, one).min() == 1
    assert not depth_gap(0 * one, one, 30 * one, one).any()
