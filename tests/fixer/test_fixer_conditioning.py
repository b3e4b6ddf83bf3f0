"""Holes, the warp of the reference, and the bound on colour shift (hard case 37)."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from genre_tasks.fixer.conditioning import Degraded, bound_colour_shift, conditions, fill_holes, warp_reference
from genre_tasks.fixer.network import HINTS
from genre_tasks.logs.types import Lens


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


def lens(width: int = 40, height: int = 24) -> Lens:
    return Lens(30.0, 30.0, width / 2, height / 2, width, height)


def test_the_same_viewpoint_warps_to_itself():
    image, one = torch.rand(1, 3, 24, 40), torch.ones(1, 1, 24, 40)
    warped, mask = warp_reference(image, one * 7, one, [(np.eye(4), np.eye(4))], [(lens(), lens())])
    torch.testing.assert_close(warped, image, atol=1e-5, rtol=0)
    assert mask.all()


def test_a_shifted_plane_moves_by_its_disparity():
    # the view stands 2 m to the right; a plane at 10 m is 30 · 2 / 10 = 6 pixels further left in it
    image, one = torch.rand(1, 3, 24, 40), torch.ones(1, 1, 24, 40)
    pose = np.eye(4)
    pose[0, 3] = 2.0
    warped, mask = warp_reference(image, one * 10, one, [(pose, np.eye(4))], [(lens(), lens())])
    torch.testing.assert_close(warped[..., :34], image[..., 6:], atol=1e-4, rtol=0)
    assert mask[..., :34].all() and not mask[..., 34:].any() and not warped[..., 34:].any()


def test_unknown_depth_and_thin_renders_are_not_warped():
    image, one = torch.rand(1, 3, 24, 40), torch.ones(1, 1, 24, 40)
    depth, alpha = one * 10, one.clone()
    depth[..., 0], depth[..., 1], depth[..., 2], alpha[..., 3] = 0, float("nan"), float("inf"), 0.2
    warped, mask = warp_reference(image, depth, alpha, [(np.eye(4), np.eye(4))], [(lens(), lens())])
    assert torch.isfinite(warped).all()
    assert not mask[..., :4].any() and mask[..., 4:].all()


def test_what_lies_behind_the_reference_is_not_warped():
    image, one = torch.rand(1, 3, 24, 40), torch.ones(1, 1, 24, 40)
    ahead = np.eye(4)
    ahead[2, 3] = 20.0  # the reference stands 20 m further ahead than the view
    warped, mask = warp_reference(image, one * 5, one, [(np.eye(4), ahead)], [(lens(), lens())])
    assert not mask.any() and torch.isfinite(warped).all()


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


def test_what_a_nearer_thing_hides_is_not_warped():
    # a post at 4 m before a wall at 20 m; the reference stands 2 m to the left of the view, and sees the post where the
    # view's wall pixels (30 · 2 / 4 − 30 · 2 / 20 = 12 px beside the view's post) lie behind it
    image, one = torch.rand(1, 3, 24, 40), torch.ones(1, 1, 24, 40)
    depth = one * 20
    depth[..., 10:14] = 4
    pose = np.eye(4)
    pose[0, 3] = 2.0
    _, mask = warp_reference(image, depth, one, [(pose, np.eye(4))], [(lens(), lens())])
    assert mask[..., 10:14].all()
    assert not mask[..., 22:26].any()
    assert mask[..., 28:36].all() and mask[..., :10].all()


def test_agreement_and_sharpness_are_told():
    sharp = torch.rand(1, 3, 16, 24)
    one, zero = torch.ones(1, 1, 16, 24), torch.zeros(1, 1, 16, 24)
    views = Degraded(sharp * 0 + 0.5, one, sharp * 0, zero, sharp, sharp, one, sharp * 0, zero)
    hints = conditions(views).hints
    assert hints.shape == (1, HINTS, 16, 24)
    lidar, warp, lidar_warp, render_sharp, warp_sharp, lidar_warp_sharp = hints[0, 10:]
    assert not lidar.any() and not lidar_warp.any()  # nothing there, nothing that disagrees
    assert warp.mean() > 0.1 and warp_sharp.mean() > 2
    assert not render_sharp.any() and not lidar_warp_sharp.any()
