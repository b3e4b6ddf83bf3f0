"""The rendering loss: its terms, its weights, and inputs that have nothing to say."""

from __future__ import annotations

import pytest
import torch

from genre_tasks.config import LossConfig
from genre_tasks.losses.exposed_renders import ExposedRenders
from genre_tasks.losses.rendering_loss import depth_loss, image_gradients, select_loss_terms, view_loss
from genre_tasks.losses.ssim import SsimTarget, ssim
from genre_tasks.losses.targets import Target
from genre_tasks.metrics.perceptual import perceptual_distance
from tests.optimiser.street_scenes import LENS, pose


def _target(seed: int = 0, novel: bool = False, depth: torch.Tensor | None = None) -> Target:
    image = torch.rand(32, 48, 3, generator=torch.Generator().manual_seed(seed))
    return Target("c", 0, pose(0.0), LENS, SsimTarget.from_image(image), depth, novel)


def test_a_view_is_the_weighted_sum_of_its_terms() -> None:
    torch.manual_seed(0)
    depth, color = torch.full((32, 48), 4.0), torch.rand(32, 48, 3)
    target = _target(depth=torch.full((32, 48), 5.0))
    value = view_loss(LossConfig(perceptual=0), color, depth, target)
    rgb = (color - target.image.pixels).abs().mean()
    expected = 0.8 * rgb + 0.2 * (1 - ssim(color, target.image)) + 0.01 * 0.25
    assert float(value) == pytest.approx(float(expected), abs=1e-6)


def test_novel_views_count_with_their_weight_and_without_depth() -> None:
    config = LossConfig(perceptual=0, novel=0.5)
    targets = [_target(0), _target(1), _target(2, novel=True)]
    terms = select_loss_terms(config, targets, 1, torch.Generator())
    assert terms.weights == (0.5, 0.5, 0.5)
    color, depth = torch.rand(3, 32, 48, 3), torch.ones(3, 32, 48)
    renders = ExposedRenders.from_renders(color, targets)
    loss, color_gradient, depth_gradient = image_gradients(config, renders, depth, terms)
    expected = sum(0.5 * float(view_loss(config, color[i], depth[i], t)) for i, t in enumerate(targets))
    assert loss == pytest.approx(expected, rel=1e-6)
    assert not depth_gradient.any() and bool((color_gradient != 0).any())


def test_the_perceptual_term_is_taken_every_nth_iteration_on_one_view_of_each_kind() -> None:
    config = LossConfig(perceptual_every=4)
    targets = [_target(i, novel=i > 2) for i in range(5)]
    taken = [select_loss_terms(config, targets, i, torch.Generator().manual_seed(i)).crops for i in range(8)]
    for i, crops in enumerate(taken):
        kinds = [targets[k].novel for k, c in enumerate(crops) if c is not None]
        assert kinds == ([False, True] if i % 4 == 0 else [])
    row, column, height, width = next(c for c in taken[0] if c is not None)
    assert row + height <= 32 and column + width <= 48


def test_the_perceptual_term_is_taken_of_as_many_views_as_are_asked_for_and_there() -> None:
    targets = [_target(i, novel=i > 2) for i in range(5)]
    one, two, many = (LossConfig(perceptual_every=1, perceptual_views=n) for n in (1, 2, 9))
    of_two = set()
    for seed in range(20):
        first, some, every = (
            select_loss_terms(c, targets, 0, torch.Generator().manual_seed(seed)).crops for c in (one, two, many)
        )
        of_two.add(tuple(k for k, c in enumerate(some) if c is not None))
        assert None not in every
        source = next(k for k, c in enumerate(first) if c is not None)
        assert some[source] == every[source] == first[source]  # the first drawn is the same
    assert of_two == {(0, 1, 3, 4), (0, 2, 3, 4), (1, 2, 3, 4)}


@pytest.mark.parametrize("broken", [0.0, float("nan"), float("inf"), -1.0])
def test_no_valid_lidar_is_no_depth_loss(broken: float) -> None:
    depth = torch.ones(4, 4, requires_grad=True)
    value = depth_loss(depth, torch.full((4, 4), broken))
    assert float(value.detach()) == 0.0


def test_depth_loss_where_nothing_is_rendered_is_finite() -> None:
    depth = torch.zeros(4, 4, requires_grad=True)
    assert float(depth_loss(depth, torch.full((4, 4), 5.0)).detach()) == 0.0
    tiny = torch.full((4, 4), 1e-30, requires_grad=True)
    depth_loss(tiny, torch.full((4, 4), 5.0)).backward()
    assert bool(torch.isfinite(tiny.grad).all())


def test_depth_gradient_points_to_the_return() -> None:
    depth = torch.full((2, 2), 6.0, requires_grad=True)
    depth_loss(depth, torch.full((2, 2), 5.0)).backward()
    assert bool((depth.grad > 0).all())


@pytest.mark.parametrize("left", [0.0, 0.5, 1.0])
@pytest.mark.parametrize("right", [0.0, 1.0])
def test_constant_images_and_small_crops_are_finite(left: float, right: float) -> None:
    image = SsimTarget.from_image(torch.full((7, 9, 3), right))
    target = Target("c", 0, pose(0.0), LENS.resized(9, 7), image, torch.zeros(7, 9))
    color, depth = torch.full((1, 7, 9, 3), left), torch.zeros(1, 7, 9)
    config = LossConfig()
    terms = select_loss_terms(config, [target], 0, torch.Generator())
    renders = ExposedRenders.from_renders(color, [target])
    loss, color_gradient, depth_gradient = image_gradients(config, renders, depth, terms, perceptual_distance())
    assert torch.isfinite(torch.tensor(loss)) and bool(
        torch.isfinite(color_gradient).all() and torch.isfinite(depth_gradient).all()
    )


def test_the_gradient_is_the_same_bytes_at_any_thread_count() -> None:
    config, targets = LossConfig(), [_target(i, novel=i > 1) for i in range(4)]
    torch.manual_seed(0)
    color, depth = torch.rand(4, 32, 48, 3), torch.ones(4, 32, 48)
    terms = select_loss_terms(config, targets, 0, torch.Generator())
    before, results = torch.get_num_threads(), []
    try:
        for threads in (1, 3):
            torch.set_num_threads(threads)
            renders = ExposedRenders.from_renders(color, targets)
            results.append(image_gradients(config, renders, depth, terms, perceptual_distance()))
    finally:
        torch.set_num_threads(before)
    assert results[0][0] == results[1][0] and torch.equal(results[0][1], results[1][1])
