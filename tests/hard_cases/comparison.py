"""A case on a backend against the float64 reference."""

from __future__ import annotations

import importlib.util
from functools import lru_cache

import pytest
import torch
from torch import Tensor

from genre_tasks.render import Render, RenderSettings, render
from genre_tasks.scene.gaussians import Splats
from tests.hard_cases.case_measurements import SCENES
from tests.hard_cases.render_cases import Case
from tests.render.oracles import Survey, agreement, relative_l2, sparsity_faults, survey
from tests.scenes import NAMES, Scene, gradients

REFERENCE = RenderSettings("reference")
SETTINGS = {"reference": REFERENCE, "cpu": RenderSettings("cpu", 1)}
CUDA_IMAGE = 0.02
"""gsplat clamps alpha at 0.999, not 0.99: up to 0.009 of each layer's colour."""

on_both = pytest.mark.parametrize("backend", SETTINGS)
_NO_GPU = importlib.util.find_spec("gsplat") is None or not torch.cuda.is_available()
on_all = pytest.mark.parametrize(
    "backend", [*SETTINGS, pytest.param("cuda", marks=pytest.mark.skipif(_NO_GPU, reason="needs gsplat and a GPU"))]
)


@lru_cache(maxsize=1)
def _truth(case: Case) -> tuple[Scene, Survey, Tensor, list[tuple[Render, dict[str, Tensor]]]]:
    """The scene, its survey, the compared pixels, and image and gradients without and with the threshold band."""
    splats, cameras = case.scene()
    seen = survey(splats, cameras, bands=case.bands)
    pixels = band_mask(seen.band, case.bands)
    assert float(seen.band[pixels].double().mean()) <= case.share
    masks = [pixels & ~seen.band, pixels] if case.whole else [pixels & ~seen.band]
    exact = [gradients(splats, cameras, REFERENCE, torch.float64, m, case.bands) for m in masks]
    return (splats, cameras), seen, pixels, exact


def band_mask(like: Tensor, bands: tuple[int, ...] | None) -> Tensor:
    """[V, H, W] bool: the rows of these bands of 16, or all."""
    rows = torch.arange(like.shape[1]) // 16
    chosen = torch.ones_like(rows) > 0 if bands is None else torch.isin(rows, torch.tensor(bands))
    return chosen[None, :, None].expand(like.shape)


def assert_matches_float64(case: Case, backend: str, stability) -> None:
    """Finite everywhere, alpha in [0, 1], the same Gaussians culled, image and gradients within the case's bounds."""
    if backend == "reference" and not case.light:
        pytest.skip("takes long and shows nothing new")
    (splats, cameras), seen, pixels, (exact, *whole) = _truth(case)
    truth = exact[0]
    assert truth.culled == case.culled
    if backend == "cuda":
        out = render(splats.to("cuda"), cameras)
        image = Render(out.color.cpu(), out.alpha.cpu(), out.depth.cpu())
        assert agreement(image, truth, seen.band | ~pixels).outside <= CUDA_IMAGE
        return
    bands = case.bands if backend == "reference" else None
    rows = SCENES[case]
    image, found = gradients(splats, cameras, SETTINGS[backend], mask=pixels & ~seen.band, bands=bands)
    assert all(bool(x.isfinite().all()) for x in (image.color, image.alpha, image.depth, *found.values()))
    alpha = image.alpha.detach()
    assert float(alpha.min()) >= 0 and float(alpha.max()) <= 1 + 1e-6
    assert image.culled == case.culled
    if case.bands is None:
        assert sparsity_faults(found, seen) == (0, 0)
    stability.record(rows[0], backend, agreement(image, truth, seen.band | ~pixels).outside)
    stability.record(rows[1], backend, worst(found, exact[1]))
    for _, expected in whole:
        _, found = gradients(splats, cameras, SETTINGS[backend], mask=pixels, bands=bands)
        stability.record(rows[2], backend, worst(found, expected))


def worst(found: dict[str, Tensor], exact: dict[str, Tensor], names: tuple[str, ...] = NAMES) -> float:
    """Largest relative L2 error over the attributes."""
    return max(relative_l2(found[n], exact[n]) for n in names)


def changed_bits(a: Tensor, b: Tensor) -> int:
    """How many entries differ."""
    return int((a != b).sum())


def different(a: Render, b: Render) -> int:
    """How many values of two renders differ."""
    return sum(changed_bits(getattr(a, n), getattr(b, n)) for n in ("color", "alpha", "depth"))


def joined(*parts: Splats) -> Splats:
    """One after the other."""
    return Splats(*(torch.cat([getattr(p, n) for p in parts]) for n in NAMES))
