"""The weights that ship: they load, are small, leave a true image alone and repair a blurred one."""

from __future__ import annotations

import pytest
import torch
import torch.nn.functional as F

from genre_tasks.config import FnetConfig
from genre_tasks.fixer.conditioning import MAX_COLOUR_SHIFT
from genre_tasks.fixer.inference import draw_noise, fix
from genre_tasks.fixer.inputs import FixerInputs
from genre_tasks.fixer.network import Fnet
from genre_tasks.logs.registry import open_log
from genre_tasks.stages.fnet import load_configured_fnet
from genre_tasks.weights import resolve_weights


@pytest.fixture(scope="module")
def shipped() -> Fnet:
    return load_configured_fnet(FnetConfig())


@pytest.fixture(scope="module")
def image() -> torch.Tensor:
    """[1, 3, 180, 320] the front camera of a validation street."""
    log = open_log("synthetic:street?seed=950&frames=1&cameras=1&lidar=0")
    assert log.truth is not None
    picture = log.truth.image(0, log.world_SE3_camera("front_camera", 0), log.cameras[0].lens)
    return torch.from_numpy(picture).permute(2, 0, 1)[None] / 255


def views_of(render: torch.Tensor, warped: torch.Tensor | None = None) -> FixerInputs:
    """An opaque render, without LiDAR; the reference is the warp, or the render itself."""
    one, zero = torch.ones_like(render[:, :1]), torch.zeros_like(render[:, :1])
    if warped is None:
        nothing = (render * 0, zero, zero)
        return FixerInputs(render, one, render * 0, zero, render, *nothing, *nothing, zero)
    return FixerInputs(render, one, render * 0, zero, warped, *(2 * (warped, one, zero)), zero)


def psnr(a: torch.Tensor, b: torch.Tensor) -> float:
    return float(-10 * (a - b).square().mean().clamp_min(1e-10).log10())


def repair(shipped: Fnet, views: FixerInputs, seed: int = 0) -> torch.Tensor:
    return fix(shipped, views, draw_noise(shipped, seed, range(1), *views.color.shape[-2:]))


def test_they_are_small_and_described():
    path = resolve_weights("fnet", "builtin")
    assert path.stat().st_size < 5_000_000
    assert path.with_suffix(".json").exists() and path.with_suffix(".md").exists()


def test_a_true_image_comes_back(shipped, image):
    assert psnr(repair(shipped, views_of(image)), image) >= 35
    assert psnr(repair(shipped, views_of(image, image)), image) >= 35


def test_a_blurred_render_beside_a_sharp_reference_is_repaired(shipped, image):
    blurred = F.avg_pool2d(F.pad(image, (4, 4, 4, 4), mode="replicate"), 9, 1)
    fixed = repair(shipped, views_of(blurred, image))
    assert psnr(fixed, image) >= psnr(blurred, image) + 1
    assert (fixed.mean((2, 3)) - blurred.mean((2, 3))).abs().max() <= MAX_COLOUR_SHIFT + 1e-5


def test_half_precision_changes_less_than_a_grey_level(shipped, image):
    blurred = F.avg_pool2d(F.pad(image, (4, 4, 4, 4), mode="replicate"), 9, 1)
    views, noise = views_of(blurred, image), draw_noise(shipped, 0, range(1), *image.shape[-2:])
    whole, half = (fix(shipped, views, noise, half=h) for h in (False, True))
    assert 0 < (whole - half).abs().mean() < 1 / 255


@pytest.mark.parametrize("level", [0.0, 1.0])
@pytest.mark.parametrize("dtype", [torch.float32, torch.bfloat16])
def test_black_and_saturated_images_stay_as_they_are(image, level, dtype):
    network = load_configured_fnet(FnetConfig()).to(dtype)
    flat = torch.full_like(image, level).to(dtype)
    noise = draw_noise(network, 0, range(1), 180, 320).to(dtype)
    out = fix(network, views_of(flat), noise)
    assert torch.isfinite(out).all() and out.min() >= 0 and out.max() <= 1
    assert (out - flat).abs().mean() <= 0.03
