"""The oracles themselves: what they let pass and what they catch."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch

from genre_tasks.render import Cameras, Render, RenderSettings, render
from genre_tasks.render import constants as const
from genre_tasks.scene.gaussians import Splats
from tests.render.oracles import (
    agreement,
    alpha_excess,
    cosine,
    reference_bands,
    relative_l2,
    sparsity_faults,
    survey,
)

REFERENCE = RenderSettings("reference")


def _camera() -> Cameras:
    return Cameras(torch.eye(4)[None], torch.full((1, 2), 50.0), torch.full((1, 2), 8.5), 17, 17)


def _on_axis(depths: list[float], opacities: list[float]) -> Splats:
    n = len(depths)
    means = torch.zeros(n, 3, dtype=torch.float64)
    means[:, 2] = torch.tensor(depths, dtype=torch.float64)
    one = torch.ones(n, 1, dtype=torch.float64)
    quats = one * torch.tensor([1.0, 0, 0, 0])
    return Splats(means, 0.2 * one.expand(n, 3), quats, torch.tensor(opacities, dtype=torch.float64), one.expand(n, 3))


def test_layers_and_peak_are_the_analytic_ones():
    seen = survey(_on_axis([5.0, 6.0], [0.8, 0.5]), _camera())
    assert int(seen.layers[0, 8, 8]) == 2 and float(seen.peak[0, 8, 8]) == pytest.approx(0.8, rel=1e-5)
    assert int(seen.layers[0, 0, 0]) == 0 and float(seen.peak[0, 0, 0]) == 0
    assert seen.drawn.tolist() == [True, True] and not bool(seen.absent.any()) and not bool(seen.band.any())


def test_the_cut_is_a_band_of_its_pixels():
    variance = (50 * 0.2 / 5) ** 2 + const.BLUR_PX2
    at_three_px = const.ALPHA_MIN * math.exp(9 / (2 * variance))
    seen = survey(_on_axis([5.0], [at_three_px]), _camera())
    assert sorted(torch.nonzero(seen.band[0]).tolist()) == [[5, 8], [8, 5], [8, 11], [11, 8]]
    assert not bool(survey(_on_axis([5.0], [at_three_px * 1.001]), _camera()).band.any())
    assert bool(survey(_on_axis([5.0], [at_three_px * 1.001]), _camera(), margin=0.01).band[0, 8, 5])


def test_a_gaussian_at_the_cut_itself_is_neither_drawn_nor_absent():
    for factor, drawn, absent in ((1 - 1e-7, False, False), (1 - 1e-4, False, True), (1 + 1e-4, True, False)):
        seen = survey(_on_axis([5.0], [const.ALPHA_MIN * factor]), _camera())
        assert (bool(seen.drawn[0]), bool(seen.absent[0])) == (drawn, absent), factor


def test_clamp_and_stop_are_in_the_band_within_the_margin():
    clamped = _on_axis([5.0], [const.ALPHA_MAX])
    assert torch.nonzero(survey(clamped, _camera()).band[0]).tolist() == [[8, 8]]
    left = const.TRANSMITTANCE_STOP / (1 - 0.9) ** 3
    stopped = _on_axis([5.0, 6.0, 7.0, 8.0], [0.9, 0.9, 0.9, 1 - left * (1 + 1e-8)])
    assert bool(survey(stopped, _camera()).band[0, 8, 8])
    further = _on_axis([5.0, 6.0, 7.0, 8.0], [0.9, 0.9, 0.9, 1 - left * 1.01])
    assert not bool(survey(further, _camera()).band[0, 8, 8])
    assert bool(survey(further, _camera(), margin=0.02).band[0, 8, 8])


@pytest.mark.parametrize(("gap", "tied"), [(1e-7, True), (0.0, False), (1e-3, False)])
def test_depths_that_rounding_may_swap_are_in_the_band(gap, tied):
    assert bool(survey(_on_axis([5.0, 5.0 + gap], [0.5, 0.5]), _camera()).band[0, 8, 8]) == tied


def test_what_lies_behind_opaque_layers_or_is_poisoned_is_absent():
    splats = _on_axis([5.0, 6.0, 7.0, 8.0], [1.0, 1.0, 0.5, 0.5])
    wide = replace(splats, scales=torch.tensor([[5.0], [5.0], [0.1], [0.1]]).expand(4, 3).double())
    colors = wide.colors.clone()
    colors[3, 1] = math.nan
    seen = survey(replace(wide, colors=colors), _camera())
    assert seen.drawn.tolist() == [True, True, False, False] and seen.absent.tolist() == [False, False, True, True]


def test_sparsity_faults_of_both_kinds(scene, gradients):
    splats, cameras = scene(60, 33, 17)
    splats = replace(splats, means=torch.where(torch.arange(60)[:, None] < 9, -splats.means, splats.means))
    seen = survey(splats, cameras)
    _, grads = gradients(splats, cameras, RenderSettings("cpu", 1))
    assert sparsity_faults(grads, seen) == (0, 0) and int(seen.drawn.sum()) > 30
    leaking = {n: g + (torch.arange(60) == 3).reshape(-1, *[1] * (g.ndim - 1)) * 1e-30 for n, g in grads.items()}
    first = int(torch.nonzero(seen.drawn)[0])
    forgetful = {n: g * (torch.arange(60) != first).reshape(-1, *[1] * (g.ndim - 1)) for n, g in grads.items()}
    assert sparsity_faults(leaking, seen) == (1, 0) and sparsity_faults(forgetful, seen) == (0, 1)


def test_agreement_separates_the_band_and_catches_nan(scene):
    splats, cameras = scene(300)
    truth = render(splats.to(torch.float64), cameras, REFERENCE)
    band = survey(splats, cameras).band
    assert 0 < float(band.double().mean()) < 0.02
    place = tuple(torch.nonzero(band)[0].tolist())
    color = truth.color.clone()
    color[place] += 0.25
    found = agreement(Render(color, truth.alpha, truth.depth), truth, band)
    assert found.outside == 0 and found.inside == pytest.approx(0.25)
    assert found.share == pytest.approx(float(band.double().mean()))
    color[tuple(torch.nonzero(~band)[0].tolist())] = math.nan
    assert agreement(Render(color, truth.alpha, truth.depth), truth, band).outside == math.inf
    depth = agreement(Render(truth.color, truth.alpha, truth.depth + 0.5), truth, band)
    assert depth.outside == pytest.approx(0.5 / float(truth.depth.max()))


def test_a_wrong_renderer_is_caught_outside_of_the_band(scene):
    """The band must not be where all errors go: scales that are one per cent too large are seen."""
    splats, cameras = scene(300)
    truth = render(splats.to(torch.float64), cameras, REFERENCE)
    wrong = render(replace(splats, scales=splats.scales * 1.01), cameras, RenderSettings("cpu", 1))
    assert agreement(wrong, truth, survey(splats, cameras).band).outside > 1e-3


def test_distances_of_gradients():
    exact = torch.tensor([3.0, 4.0])
    assert relative_l2(torch.tensor([3.0, 4.5]), exact) == pytest.approx(0.1)
    assert relative_l2(exact * 1e-30, exact.double() * 1e-30) < 1e-6
    assert relative_l2(torch.zeros(2), torch.zeros(2)) == 0 and relative_l2(exact, torch.zeros(2)) == math.inf
    assert relative_l2(torch.tensor([math.nan, 1.0]), exact) == math.inf
    assert cosine(7e-25 * exact, exact) == pytest.approx(1) and cosine(-exact, exact) == pytest.approx(-1)
    assert cosine(torch.tensor([4.0, -3.0]), exact) == pytest.approx(0, abs=1e-12)


def test_alpha_excess_is_the_distance_to_the_bound():
    splats = _on_axis([5.0, 6.0], [0.5, 0.5])
    seen = survey(splats, _camera())
    alpha = render(splats, _camera(), REFERENCE).alpha
    middle = replace(seen, peak=seen.peak[:, 8:9, 8:9], layers=seen.layers[:, 8:9, 8:9])
    assert abs(alpha_excess(alpha[:, 8:9, 8:9], middle)) < 1e-5
    assert alpha_excess(alpha + 0.01, seen) == pytest.approx(0.01, abs=1e-5)


def test_bands_are_the_rows_of_the_image(scene, gradients):
    splats, cameras = scene(200, 40, 50, views=2)
    whole, part = render(splats, cameras, REFERENCE), reference_bands(splats, cameras, (1, 3))
    rows = torch.zeros(2, 50, 40, dtype=torch.bool)
    rows[:, 16:32] = rows[:, 48:] = True
    for name in ("color", "alpha", "depth"):
        image, full = getattr(part, name), getattr(whole, name)
        assert torch.equal(image[rows], full[rows]) and not bool(image[~rows].any())
    assert part.culled == whole.culled
    _, grads = gradients(splats, cameras, REFERENCE, mask=rows, bands=(1, 3))
    _, expected = gradients(splats, cameras, REFERENCE, mask=rows)
    assert all(relative_l2(grads[n], expected[n]) < 1e-5 for n in grads)
    seen = survey(splats, cameras, bands=(1, 3))
    assert torch.equal(seen.band, survey(splats, cameras).band & rows)
