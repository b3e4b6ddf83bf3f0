"""The compiled image loss against the torch code in float64, and what it does with inputs that are odd or broken."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch
from torch import Tensor

from genre_tasks.compiled.loader import supported_instruction_sets
from genre_tasks.config import LossConfig
from genre_tasks.errors import ResourceError
from genre_tasks.losses import constants as constants
from genre_tasks.losses import image_loss as module
from genre_tasks.losses.build_image_loss import KERNEL
from genre_tasks.losses.image_loss import ImageLoss, image_loss, is_supported, load_image_loss
from genre_tasks.losses.rendering_loss import torch_image_loss
from genre_tasks.losses.ssim import SsimTarget
from genre_tasks.losses.targets import Target
from tests.optimiser.street_scenes import LENS, pose

CONFIG = LossConfig(rgb=0.8, ssim=0.2, perceptual=0.0, depth=0.5)
Batch = tuple[Tensor, Tensor, list[Target], list[float]]


def _target(image: Tensor, depth: Tensor | None = None) -> Target:
    return Target("c", 0, pose(0.0), LENS, SsimTarget.from_image(image), depth, depth is None)


def _batch(views: int = 3, height: int = 37, width: int = 53, seed: int = 0) -> Batch:
    """Views that resemble their targets; sparse LiDAR returns with errors to and past the clamp, the last without."""
    g = torch.Generator().manual_seed(seed)
    color = torch.rand(views, height, width, 3, generator=g)
    depth = 30 * torch.rand(views, height, width, generator=g)
    depth[torch.rand(depth.shape, generator=g) < 0.1] = 0
    targets = []
    for i in range(views):
        image = (color[i] + 0.3 * torch.randn(color[i].shape, generator=g)).clamp(0, 1)
        returns = depth[i] * (0.3 + 2.2 * torch.rand(depth[i].shape, generator=g))
        returns[torch.rand(returns.shape, generator=g) < 0.7] = 0
        targets.append(_target(image, returns if i < views - 1 or views == 1 else None))
    return color, depth, targets, [0.5, 0.25, 0.125, 1.0][:views]


def _without_statistics(batch: Batch) -> Batch:
    """The same views with images as large ones have them: the kernel computes their mean and variance itself."""
    color, depth, targets, weights = batch
    return color, depth, [replace(t, image=SsimTarget(t.image.pixels)) for t in targets], weights


def _oracle(batch: Batch, config: LossConfig = CONFIG) -> ImageLoss:
    color, depth, targets, weights = batch
    exact = [
        replace(
            t, image=SsimTarget.from_image(t.image.pixels.double()), depth=None if t.depth is None else t.depth.double()
        )
        for t in targets
    ]
    return torch_image_loss(config, color.double(), depth.double(), exact, weights)


def _assert_close(ours: ImageLoss, exact: ImageLoss, bound: float = 1e-5) -> None:
    assert ours.losses.dtype == torch.float64
    assert ours.losses.tolist() == pytest.approx(exact.losses.tolist(), rel=bound)
    for name in ("color_gradient", "depth_gradient"):
        a, b = getattr(ours, name).double(), getattr(exact, name)
        assert a.shape == b.shape
        assert float((a - b).abs().max()) <= bound * max(float(b.abs().max()), 1e-30), name


@pytest.mark.parametrize(
    "size", [(37, 53), (4, 4), (1, 1), (1, 40), (40, 1), (5, 3), (11, 11), (12, 16), (13, 17), (8, 64), (64, 33)]
)
def test_values_and_gradients_are_the_oracles(size: tuple[int, int]) -> None:
    batch = _batch(3, *size)
    _assert_close(image_loss(CONFIG, *batch), _oracle(batch))
    _assert_close(image_loss(CONFIG, *_without_statistics(batch)), _oracle(batch))


@pytest.mark.parametrize("change", [{"ssim": 0.0}, {"depth": 0.0}, {"rgb": 0.0}, {"rgb": 0.0, "ssim": 0.0}])
def test_each_term_can_be_left_out(change: dict[str, float]) -> None:
    batch, config = _batch(), CONFIG.model_copy(update=change)
    _assert_close(image_loss(config, *batch), _oracle(batch, config))


@pytest.mark.parametrize("isa", supported_instruction_sets())
def test_every_instruction_set_is_right(isa: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("GENRE_RENDER_ISA", isa)
    monkeypatch.setattr(module, "load_image_loss", load_image_loss.__wrapped__)
    batch = _batch()
    _assert_close(image_loss(CONFIG, *batch), _oracle(batch))
    _assert_close(image_loss(CONFIG, *_without_statistics(batch)), _oracle(batch))


def test_smooth_images_are_as_exact_as_in_torch() -> None:
    """Local variances are differences of close numbers: float32 loses digits there, in both in the same way."""
    x, y = torch.meshgrid(torch.linspace(0, 1, 60), torch.linspace(0, 1, 80), indexing="ij")
    color = torch.stack([x, y, 0.5 * (x + y)], -1)[None]
    batch = color, torch.zeros(1, 60, 80), [_target(color[0] * 0.9 + 0.05)], [1.0]
    _assert_close(image_loss(CONFIG, *batch), _oracle(batch), 1e-3)
    _assert_close(image_loss(CONFIG, *_without_statistics(batch)), _oracle(batch), 1e-3)


@pytest.mark.parametrize("returns", [0.0, float("nan"), float("inf"), -1.0])
def test_no_lidar_return_is_no_depth_loss(returns: float) -> None:
    color, depth, targets, weights = _batch(1)
    targets = [replace(targets[0], depth=torch.full(depth.shape[1:], returns))]
    with_depth = image_loss(CONFIG, color, depth + 1, targets, weights)
    without = image_loss(CONFIG, color, depth + 1, [replace(targets[0], depth=None)], weights)
    assert torch.equal(with_depth.losses, without.losses) and not with_depth.depth_gradient.any()


def test_depth_gradients_stop_where_they_are_clamped() -> None:
    """Left of and at the smallest depth, at and past the largest error, at the return, and with nothing rendered."""
    depth = torch.tensor([[[1e-30, 5e-4, 1e-3, 2.0, 2.0, 2.0, 0.0, -1.0, float("inf"), float("nan")]]])
    returns = torch.tensor([[1e-3, 1e-3, 1.5e-3, 4.0, 4.1, 2.0, 5.0, 5.0, 5.0, 5.0]])
    color = torch.zeros(1, 1, 10, 3)
    batch = color, depth, [_target(color[0], returns)], [1.0]
    ours, torchs = image_loss(CONFIG, *batch), torch_image_loss(CONFIG, *batch)
    assert ours.depth_gradient.tolist()[0][0] == pytest.approx(torchs.depth_gradient.tolist()[0][0], rel=1e-6)
    assert ours.losses.tolist() == pytest.approx(torchs.losses.tolist(), rel=1e-6)
    assert [bool(x) for x in ours.depth_gradient[0, 0]] == [i in (2, 3) for i in range(10)]


@pytest.mark.parametrize("broken", [float("nan"), float("inf"), float("-inf")])
@pytest.mark.parametrize("where", ["color", "image"])
def test_what_is_not_finite_shows_in_its_view_and_nowhere_else(broken: float, where: str) -> None:
    color, depth, targets, weights = _batch()
    if where == "color":
        color[1, 20, 30, 1] = broken
    else:
        image = targets[1].image.pixels.clone()
        image[20, 30, 1] = broken
        targets[1] = replace(targets[1], image=SsimTarget.from_image(image))
    batch = color, depth, targets, weights
    ours, torchs = image_loss(CONFIG, *batch), torch_image_loss(CONFIG, *batch)
    assert torch.isfinite(ours.losses).tolist() == torch.isfinite(torchs.losses).tolist() == [True, False, True]
    assert torch.equal(torch.isfinite(ours.color_gradient), torch.isfinite(torchs.color_gradient))
    assert torch.equal(torch.isfinite(ours.depth_gradient), torch.isfinite(torchs.depth_gradient))


def test_identical_images_have_no_loss_and_no_gradient() -> None:
    color, depth, _, _ = _batch(1)
    ours = image_loss(CONFIG, color, depth, [_target(color[0])], [1.0])
    assert abs(float(ours.losses)) < 1e-6
    assert float(ours.color_gradient.abs().max()) < 1e-5 / color.numel()


def test_the_same_bits_at_any_thread_count_and_alone() -> None:
    color, depth, targets, weights = batch = _batch(4, 64, 48)
    before, results = torch.get_num_threads(), []
    try:
        for threads in (1, 2, 3):
            torch.set_num_threads(threads)
            results.append(image_loss(CONFIG, *batch))
    finally:
        torch.set_num_threads(before)
    alone = [image_loss(CONFIG, color[i : i + 1], depth[i : i + 1], [targets[i]], [weights[i]]) for i in range(4)]
    for name in ("losses", "color_gradient", "depth_gradient"):
        first = getattr(results[0], name)
        assert all(torch.equal(first, getattr(r, name)) for r in results[1:])
        assert torch.equal(first, torch.cat([getattr(r, name) for r in alone]))


def test_tensors_need_not_be_contiguous() -> None:
    color, depth, targets, weights = batch = _batch()
    strided = color.permute(3, 0, 1, 2).contiguous().permute(1, 2, 3, 0), depth.mT.contiguous().mT, targets, weights
    assert torch.equal(image_loss(CONFIG, *strided).color_gradient, image_loss(CONFIG, *batch).color_gradient)
    assert torch.equal(image_loss(CONFIG, *strided).depth_gradient, image_loss(CONFIG, *batch).depth_gradient)


def _assert_refused(
    color: Tensor, depth: Tensor, targets: Sequence[Target], weights: Sequence[float], match: str
) -> None:
    with pytest.raises(ValueError, match=match):
        image_loss(CONFIG, color, depth, targets, weights)


def test_what_does_not_fit_is_refused() -> None:
    color, depth, targets, weights = _batch()
    other = _batch(height=36)[2]
    _assert_refused(color[0], depth, targets, weights, r"expected colour \[V, H, W, 3\]")
    _assert_refused(color, depth[:, 1:], targets, weights, "expected colour")
    _assert_refused(color, depth, targets[:2], weights, "expected 3 targets and weights, got 2 and 3")
    _assert_refused(color, depth, targets, weights[:2], "expected 3 targets and weights, got 3 and 2")
    _assert_refused(color, depth, other, weights, r"expected a target image of shape \(37, 53, 3\), got \(36, 53, 3\)")
    lacking = replace(targets[0], image=replace(targets[0].image, mean=other[0].image.mean))
    _assert_refused(color, depth, [lacking, *targets[1:]], weights, "expected a target mean")
    _assert_refused(
        color, depth, [replace(targets[0], depth=other[0].depth), *targets[1:]], weights, "LiDAR depth of shape"
    )
    _assert_refused(color.double(), depth, targets, weights, "float32")


def test_it_is_for_float32_on_the_cpu() -> None:
    color, depth, targets, _ = _batch()
    assert is_supported(color, depth, targets)
    assert not is_supported(color.double(), depth, targets)
    assert not is_supported(color.to("meta"), depth, targets)
    assert not is_supported(
        color, depth, [replace(targets[0], image=SsimTarget.from_image(targets[0].image.pixels.double()))]
    )


@pytest.mark.parametrize(("status", "match"), [(1, "not enough memory.*fewer views"), (2, "kernel failed")])
def test_a_failing_kernel_is_an_error(status: int, match: str, monkeypatch: pytest.MonkeyPatch) -> None:
    kernel = SimpleNamespace(genre_image_loss=lambda *arguments: status)
    monkeypatch.setattr(module, "load_image_loss", lambda: kernel)
    with pytest.raises(ResourceError, match=match):
        image_loss(CONFIG, *_batch())


def test_constants_live_in_one_place() -> None:
    text = (KERNEL.folder / "image_loss.cpp").read_text()
    assert {n for n in vars(constants) if n.isupper()} == set(KERNEL.constants)
    assert all(re.search(rf"\b{name}\b", text) for name in KERNEL.constants)


def test_a_missing_library_says_what_to_run(tmp_path: Path) -> None:
    with pytest.raises(ResourceError, match=r"image loss's CPU kernel is not compiled.*pip install -e \."):
        load_image_loss(tmp_path)
