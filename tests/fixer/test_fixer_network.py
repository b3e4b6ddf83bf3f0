"""The network: equations, view mixing, identity before training, gradients, hard cases 33–36."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import pytest
import torch
import torch.nn.functional as F

from genre_tasks.errors import NonFiniteError
from genre_tasks.fixer.architectures import add_lora, build_fnet, small_architecture
from genre_tasks.fixer.attention import ViewMixingProcessor
from genre_tasks.fixer.conditioning import build_conditions, pad_to_stride
from genre_tasks.fixer.inference import OVERLAP_PX, _fade, _windows, draw_noise, fix
from genre_tasks.fixer.inputs import FixerInputs, mask_inputs
from genre_tasks.fixer.network import compute_noise_level
from tests.fixer.conftest import random_views, toy


def test_sigma_of_the_papers_timestep():
    sigma, scale = compute_noise_level(200)
    assert sigma == pytest.approx(0.5717, abs=1e-3)
    assert scale == pytest.approx((1 + sigma**2) ** -0.5)
    from diffusers import EulerDiscreteScheduler

    scheduler = EulerDiscreteScheduler(beta_start=0.00085, beta_end=0.012, beta_schedule="scaled_linear")
    scheduler.set_timesteps(timesteps=[200])
    latent = torch.randn(1, 4, 4, 4)
    expected = scheduler.scale_model_input(latent, scheduler.timesteps[0])
    torch.testing.assert_close(latent * scale, expected, rtol=1e-4, atol=1e-5)


def test_an_untrained_fixer_returns_the_filled_render():
    fnet = toy(trained=False)
    views = random_views(2, 32, 48)
    out = fix(fnet, views, draw_noise(fnet, 0, range(2), 32, 48))
    torch.testing.assert_close(out, build_conditions(views).render, rtol=0, atol=1e-6)


def test_latent_follows_the_papers_equations(monkeypatch):
    fnet = toy()
    render, reference, lidar, noise = torch.randn(4, 2, 4, 4, 6)
    seen = {}

    class Unet(torch.nn.Module):
        def forward(self, sample, timestep, text, cross_attention_kwargs):
            seen.update(sample=sample, timestep=timestep, text=text, views=cross_attention_kwargs["views"])
            return type("Out", (), {"sample": sample + 1})

    monkeypatch.setattr(fnet, "unet", Unet())
    out = fnet.denoise(render, reference, lidar, noise)
    noisy = render + fnet.sigma * noise
    scaled = noisy * fnet.input_scale
    assert (seen["timestep"], seen["text"], seen["views"]) == (200, None, 3)
    torch.testing.assert_close(seen["sample"].unflatten(0, (2, 3))[:, 0], scaled)
    torch.testing.assert_close(seen["sample"].unflatten(0, (2, 3))[:, 1], reference)
    torch.testing.assert_close(seen["sample"].unflatten(0, (2, 3))[:, 2], lidar)
    torch.testing.assert_close(out, noisy - fnet.sigma * (scaled + 1))


def test_encode_is_the_autoencoders_own():
    fnet = toy()
    image = torch.rand(2, 3, 32, 48)
    ours = fnet.encode(image)
    theirs = fnet.vae.encode(image * 2 - 1).latent_dist.mode() * fnet.vae.config.scaling_factor
    assert torch.equal(ours.latent, theirs)
    assert [f.shape[-2] for f in ours.features] == [32, 16, 8, 4]


def test_one_view_is_the_default_attention_exactly():
    from diffusers.models.attention_processor import AttnProcessor2_0

    fnet = toy()
    assert all(isinstance(p, ViewMixingProcessor) for p in fnet.unet.attn_processors.values())
    assert len(fnet.unet.attn_processors) == 2 + 1 + 4  # two down blocks, the middle, two up blocks of two layers
    latent = torch.randn(3, 4, 4, 6)
    mixed = fnet.unet(latent, 200, None, cross_attention_kwargs={"views": 1}).sample
    together = fnet.unet(latent, 200, None, cross_attention_kwargs={"views": 3}).sample
    fnet.unet.set_attn_processor(AttnProcessor2_0())
    assert torch.equal(mixed, fnet.unet(latent, 200, None).sample)
    assert not torch.allclose(mixed, together, atol=1e-5)


def test_the_batch_must_hold_whole_samples():
    with pytest.raises(ValueError, match="multiple of 3 views, got 4"):
        toy().unet(torch.randn(4, 4, 4, 6), 200, None, cross_attention_kwargs={"views": 3})


@pytest.mark.parametrize("name", ["color", "lidar_color", "reference", "warped", "lidar_warped", "alpha"])
def test_every_input_has_an_effect(name):
    fnet, views = toy(), random_views(1, 32, 48)
    noise = draw_noise(fnet, 0, range(1), 32, 48)
    before = fnet(build_conditions(views), noise)
    changed = replace(views, **{name: getattr(views, name).flip(-1)})
    assert (fnet(build_conditions(changed), noise) - before).abs().max() > 1e-6


def test_samples_of_a_batch_do_not_mix():
    fnet, views = toy(), random_views(3, 32, 48)
    noise = draw_noise(fnet, 0, range(3), 32, 48)
    together = fix(fnet, views, noise)
    alone = torch.cat([fix(fnet, views.select(slice(k, k + 1)), noise[k : k + 1]) for k in range(3)])
    torch.testing.assert_close(together, alone, rtol=0, atol=1e-5)


def test_gradients_reach_everything_that_is_trained():
    fnet = toy().requires_grad_(True)
    fnet.vae.encoder.requires_grad_(False)
    fnet(build_conditions(random_views(1, 32, 48)), draw_noise(fnet, 0, range(1), 32, 48)).square().sum().backward()
    trained = {n: p for n, p in fnet.named_parameters() if p.requires_grad and "quant_conv" not in n}
    silent = [n for n, p in trained.items() if p.grad is None or not p.grad.abs().sum() > 0]
    assert silent == []


def test_lora_trains_adapters_and_skips_only():
    fnet = toy()
    before = {k: v.clone() for k, v in fnet.state_dict().items()}
    add_lora(fnet, rank=2)
    trained = [n for n, p in fnet.named_parameters() if p.requires_grad]
    assert trained and all("lora" in n or n.startswith("skips") for n in trained)
    assert any(n.startswith("unet") for n in trained) and any(n.startswith("vae.decoder") for n in trained)
    assert not any("encoder" in n for n in trained)
    optimiser = torch.optim.SGD([p for p in fnet.parameters() if p.requires_grad], 1e-3)
    fnet(build_conditions(random_views(1, 32, 48)), draw_noise(fnet, 0, range(1), 32, 48)).square().sum().backward()
    optimiser.step()
    after = {k.replace(".base_layer", ""): v for k, v in fnet.state_dict().items()}
    assert all(torch.equal(v, after[k]) for k, v in before.items() if not k.startswith("skips"))


def test_sizes_that_do_not_fit_the_stride_are_refused():
    fnet = toy()
    with pytest.raises(ValueError, match="multiples of 16, got 36 × 52"):
        fnet(build_conditions(random_views(1, 36, 52)), torch.zeros(1, 4, 4, 6))


@pytest.mark.parametrize(("height", "width"), [(1, 1), (17, 33), (36, 52), (90, 160)])
def test_any_size_comes_back_at_its_size(height, width):
    fnet, views = toy(), random_views(1, height, width)
    out = fix(fnet, views, draw_noise(fnet, 0, range(1), height, width))
    assert out.shape == (1, 3, height, width)
    assert torch.isfinite(out).all() and out.min() >= 0 and out.max() <= 1


@pytest.mark.parametrize("dtype", [torch.float32, torch.bfloat16, torch.float16])
@pytest.mark.parametrize("level", [0.0, 1.0])
def test_black_and_saturated_images_stay_finite(level, dtype):
    fnet = toy().to(dtype)
    full, one = torch.full((1, 3, 32, 48), level, dtype=dtype), torch.full((1, 1, 32, 48), level, dtype=dtype)
    out = fix(
        fnet,
        FixerInputs(full, one, full, one, full, full, one, one, full, one, one, one),
        draw_noise(fnet, 0, range(1), 32, 48).to(dtype),
    )
    assert out.dtype == dtype and torch.isfinite(out).all() and out.min() >= 0 and out.max() <= 1


def test_a_seed_gives_one_image_and_another_seed_another():
    fnet, views = toy(), random_views(2, 32, 48)
    first, again, other = (fix(fnet, views, draw_noise(fnet, seed, range(2), 32, 48)) for seed in (0, 0, 1))
    assert torch.equal(first, again)
    assert not torch.equal(first, other)


def test_noise_depends_on_the_view_and_not_on_its_batch():
    fnet = toy()
    noise = draw_noise(fnet, 7, range(5), 36, 52)
    assert torch.equal(noise[3:5], draw_noise(fnet, 7, range(3, 5), 36, 52))
    assert noise.shape == (5, 4, 6, 8) and not torch.equal(noise[0], noise[1])
    assert pad_to_stride(build_conditions(random_views(1, 36, 52)), 16).render.shape[-2:] == (48, 64)


def test_a_render_that_is_not_finite_is_named():
    fnet, views = toy(), random_views(1, 32, 48)
    views.color[0, 1, 2, 3] = float("nan")
    with pytest.raises(NonFiniteError, match=r"render holds 1 non-finite values, the first at index \(0, 1, 2, 3\)"):
        fix(fnet, views, draw_noise(fnet, 0, range(1), 32, 48))


def test_building_leaves_the_global_random_state_alone():
    torch.manual_seed(3)
    expected = torch.rand(3)
    torch.manual_seed(3)
    first = build_fnet(small_architecture((8, 8, 16, 16), 4, (16, 16)), 5)
    assert torch.equal(torch.rand(3), expected)
    second = build_fnet(small_architecture((8, 8, 16, 16), 4, (16, 16)), 5)
    assert all(
        torch.equal(a, b) for a, b in zip(first.state_dict().values(), second.state_dict().values(), strict=True)
    )


def test_large_images_are_fixed_in_tiles():
    """A tile cuts off what the network sees around a pixel: away from seams the whole image's values come back."""
    fnet, views = toy(), random_views(1, 300, 520)
    noise = draw_noise(fnet, 0, range(1), 300, 520)
    whole = fix(fnet, views, noise)
    reference = fnet.encode(F.pad(views.reference, (0, -520 % fnet.stride, 0, -300 % fnet.stride), mode="replicate"))
    tiled = fix(fnet, views, noise, reference, tile_px=256)
    assert tiled.shape == whole.shape and torch.isfinite(tiled).all()
    assert (tiled - whole).abs().mean() < 0.02
    with pytest.raises(ValueError, match="tiles of at least 256 px"):
        fix(fnet, views, noise, tile_px=128)


@pytest.mark.parametrize(
    ("size", "tile", "stride"), [(256, 256, 16), (272, 256, 16), (1088, 512, 16), (2000, 1024, 16)]
)
def test_windows_cover_and_overlap(size, tile, stride):
    windows = _windows(size, tile, stride)
    assert windows[0][0] == 0 and windows[-1][1] == size
    assert all(a % stride == 0 and b % stride == 0 and b - a <= tile for a, b in windows)
    assert all(b - c >= min(OVERLAP_PX, size) - stride for (_, b), (c, _) in pairwise(windows))
    weight = torch.zeros(size)
    for a, b in windows:
        weight[a:b] += _fade(a, b, size)
    assert weight.min() > 0.5


def test_an_input_that_is_not_given_changes_nothing():
    views = random_views(1, 32, 48)
    noise = draw_noise(toy(), 0, range(1), 32, 48)
    for inputs in (("render",), ("render", "reference"), ("reference", "lidar")):
        architecture = replace(small_architecture((8, 8, 16, 16), 4, (16, 16)), inputs=inputs)
        fnet = build_fnet(architecture).eval()
        fnet.load_state_dict(toy().state_dict())
        blank = mask_inputs(views, inputs)
        first, second = (fix(fnet, v, noise, fnet.encode(v.reference)) for v in (views, blank))
        assert torch.equal(first, second)
    with pytest.raises(ValueError, match="expected inputs among"):
        replace(small_architecture(), inputs=("radar",))
