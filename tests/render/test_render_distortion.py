"""A distorted lens: against the pinhole's image resampled, the float64 reference, and finite differences."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
import pytest
import torch

from genre_tasks.logs.types import Lens
from genre_tasks.render import Cameras, RenderSettings, render, render_views
from genre_tasks.render.constants import JACOBIAN_MARGIN
from genre_tasks.render.lens_domain import find_valid_domain
from genre_tasks.render.surface import render_surfaces
from genre_tasks.scene.gaussians import Gaussians, Splats
from genre_tasks.scene.graph import SceneGraph
from genre_tasks.scene.lens_distortion import distort, distortion_jacobian, fold_radius, pixels_to_rays, undistort
from genre_tasks.scene.projection import project
from tests.render.oracles import agreement, relative_l2, survey
from tests.scenes import NAMES, pose_gradient_error, smooth, street

CPU, REFERENCE = RenderSettings("cpu", 1), RenderSettings("reference")
BOTH = pytest.mark.parametrize("settings", [CPU, REFERENCE], ids=lambda s: s.backend)
BARREL = (-0.3, 0.12, 0.002, -0.0015, -0.01)
PINCUSHION = (0.15, 0.05, -0.001, 0.002, 0.02)
LENSES = pytest.mark.parametrize("lens", [BARREL, PINCUSHION], ids=["barrel", "pincushion"])


def bent(cameras: Cameras, coefficients: tuple[float, ...] = BARREL) -> Cameras:
    return replace(cameras, distortion=torch.tensor(coefficients).repeat(len(cameras), 1))


@LENSES
@pytest.mark.parametrize(("width", "height"), [(64, 48), (33, 17)])
def test_values_and_gradients_against_the_reference(scene, gradients, width, height, lens):
    splats, cameras = scene(300, width, height, views=2)
    image, grads = gradients(splats, bent(cameras, lens), CPU)
    truth, exact = gradients(splats, bent(cameras, lens), REFERENCE, torch.float64)
    assert image.culled == truth.culled
    assert (render(splats, cameras, CPU).color - image.color).detach().abs().max() > 0.05
    found = agreement(image, truth, survey(splats, bent(cameras, lens)).band)
    assert found.outside < 1e-5 and found.share < 0.02
    for name, grad in grads.items():
        assert relative_l2(grad, exact[name]) <= 1e-5, name


@LENSES
def test_reference_gradients_against_finite_differences(lens):
    splats, cameras = smooth()
    coefficients = torch.tensor([lens], dtype=torch.float64)
    inputs = [getattr(splats, n).requires_grad_() for n in NAMES] + [coefficients.requires_grad_()]

    def images(*x: torch.Tensor) -> torch.Tensor:
        out = render(Splats(*x[:5]), replace(cameras, distortion=x[5]), REFERENCE)
        return torch.cat([out.color.flatten(), out.alpha.flatten(), out.depth.flatten()])[::37]

    assert torch.autograd.gradcheck(images, inputs, eps=1e-6, atol=1e-6)


@pytest.mark.parametrize(("settings", "dtype", "bound"), [(CPU, torch.float32, 1e-5), (REFERENCE, torch.float64, 1e-7)])
def test_pose_gradient_against_finite_differences(settings, dtype, bound):
    splats, cameras = smooth()
    assert pose_gradient_error(splats, bent(cameras), settings, dtype) < bound


@BOTH
def test_it_is_the_pinhole_image_resampled(settings):
    """A wall of small Gaussians: pixel u of the lens shows what the pinhole shows at undistort(u)."""
    y, x = torch.meshgrid(torch.arange(-6, 6, 0.09), torch.arange(-8, 8, 0.09), indexing="ij")
    n = x.numel()
    means = torch.stack([x.flatten(), y.flatten(), torch.full((n,), 6.0)], 1)
    # In no order: of one depth, the first ones hide the others.
    means = means[torch.randperm(n, generator=torch.Generator().manual_seed(1))]
    pattern = 0.5 + 0.25 * torch.stack([torch.sin(2 * means[:, 0]), torch.cos(1.5 * means[:, 1]), means[:, 0] / 8], 1)
    splats = Splats(
        means, torch.full((n, 3), 0.2), torch.tensor([[1.0, 0, 0, 0]]).repeat(n, 1), torch.full((n,), 0.1), pattern
    )
    lens = Lens(60.0, 62.0, 40.0, 31.0, 80, 60, BARREL)
    wide = Lens(60.0, 62.0, 60.0, 51.0, 120, 100)
    image = render(splats, Cameras.from_poses([np.eye(4)], [lens]), settings).color[0]
    plain = render(splats, Cameras.from_poses([np.eye(4)], [wide]), settings).color
    v, u = np.meshgrid(np.arange(60) + 0.5, np.arange(80) + 0.5, indexing="ij")
    at = undistort((u - lens.cx_px) / lens.fx_px, (v - lens.cy_px) / lens.fy_px, lens.coefficients)
    px, py = at[0] * wide.fx_px + wide.cx_px, at[1] * wide.fy_px + wide.cy_px
    grid = torch.from_numpy(np.stack([2 * px / 120 - 1, 2 * py / 100 - 1], -1))[None].float()
    resampled = torch.nn.functional.grid_sample(plain.permute(0, 3, 1, 2), grid, align_corners=False)[0]
    error = (image - resampled.permute(1, 2, 0)).abs()
    assert error.max() < 0.015 and error.mean() < 0.002
    assert (image - plain[0, 20:80, 20:100]).abs().mean() > 10 * error.mean()


@BOTH
def test_zero_coefficients_are_no_distortion_and_tiny_ones_nearly(scene, gradients, settings):
    splats, cameras = scene(300, views=2)
    plain, grads = gradients(splats, cameras, settings)
    zero, same = gradients(splats, bent(cameras, (0.0,) * 5), settings)
    assert torch.equal(plain.color, zero.color) and all(torch.equal(grads[n], same[n]) for n in grads)
    tiny, close = gradients(splats, bent(cameras, (1e-9, -1e-9, 1e-9, 1e-9, 1e-9)), settings)
    assert not torch.equal(plain.color, tiny.color)
    assert (plain.color - tiny.color).abs().max() < 1e-5 and tiny.culled == plain.culled
    for name in grads:
        assert relative_l2(close[name], grads[name]) < 1e-5, name


def test_views_of_one_call_are_as_alone_at_any_thread_count(scene, gradients):
    splats, cameras = scene(300, views=3)
    table = torch.tensor([BARREL, (0.0,) * 5, PINCUSHION])
    together, grads = gradients(splats, replace(cameras, distortion=table), CPU)
    assert torch.equal(together.color[1], render(splats, cameras.select([1]), CPU).color[0])
    for v in range(3):
        alone = render(splats, replace(cameras, distortion=table).select([v]), CPU)
        assert torch.equal(alone.color[0], together.color[v])
    again, same = gradients(splats, replace(cameras, distortion=table), RenderSettings("cpu", 3))
    assert torch.equal(again.color, together.color) and all(torch.equal(grads[n], same[n]) for n in grads)


@LENSES
def test_centres_are_where_points_are_projected(lens):
    points = np.array([[0.9, -0.4, 4.0], [-0.5, 0.6, 3.0]], np.float32)
    at = Lens(55.0, 60.0, 31.0, 25.0, 64, 48, lens)
    seen = project(points, np.eye(4), at)
    rays = np.stack(pixels_to_rays(*seen.uv.astype(np.float64).T, at), 1)
    assert np.allclose(rays, points[seen.index, :2] / points[seen.index, 2:], atol=1e-5) and len(rays) == 2
    for k, uv in zip(seen.index, seen.uv, strict=True):
        out = render(_dot(points[k]), Cameras.from_poses([np.eye(4)], [at], torch.float64), REFERENCE)
        assert np.allclose(_centroid(out.alpha[0]), uv, atol=0.05)


def _dot(point: np.ndarray) -> Splats:
    one = torch.ones(1, 3, dtype=torch.float64)
    quat = torch.tensor([[1.0, 0, 0, 0]], dtype=torch.float64)
    return Splats(torch.from_numpy(point)[None].double(), 0.05 * one, quat, 0.9 * one[:, 0], one)


def _centroid(alpha: torch.Tensor) -> list[float]:
    h, w = alpha.shape
    total = alpha.sum()
    return [
        float((alpha.sum(0) * (torch.arange(w) + 0.5)).sum() / total),
        float((alpha.sum(1) * (torch.arange(h) + 0.5)).sum() / total),
    ]


@LENSES
def test_undistort_is_the_inverse_and_slopes_are_the_derivatives(lens):
    x, y = np.meshgrid(np.linspace(-0.7, 0.7, 29), np.linspace(-0.5, 0.5, 21))
    back = undistort(*distort(x, y, lens), lens)
    assert np.abs(back[0] - x).max() < 1e-12 and np.abs(back[1] - y).max() < 1e-12
    step = 1e-6
    by_x = [(a - b) / (2 * step) for a, b in zip(distort(x + step, y, lens), distort(x - step, y, lens), strict=True)]
    by_y = [(a - b) / (2 * step) for a, b in zip(distort(x, y + step, lens), distort(x, y - step, lens), strict=True)]
    xx, xy, yy = distortion_jacobian(x, y, lens)
    for found, expected in ((by_x[0], xx), (by_x[1], xy), (by_y[0], xy), (by_y[1], yy)):
        assert np.allclose(found, expected, atol=1e-8)


def test_fold_radius_is_where_the_radius_stops_growing():
    assert fold_radius((-0.3, 0, 0, 0, 0)) == pytest.approx(math.sqrt(1 / 0.9))
    assert fold_radius(PINCUSHION) == math.inf and fold_radius((-0.3, 0.1, 0, 0, 0)) == math.inf
    k = (-0.2, -0.05, 0, 0, 0.01)
    r = fold_radius(k)
    slope = [float(distortion_jacobian(np.array(r * f), np.array(0.0), k)[0]) for f in (0.999, 1.001)]
    assert slope[0] > 0 > slope[1]
    on = undistort(np.array([5.0]), np.array([0.0]), k)
    assert float(np.hypot(*on)[0]) == pytest.approx(r), "no ray arrives so far out"


@LENSES
def test_the_linearisation_reaches_over_the_whole_image(lens):
    at = Lens(55.0, 60.0, 30.0, 25.0, 64, 48, lens)
    domain = find_valid_domain(Cameras.from_poses([np.eye(4)], [at]), 0)
    u, v = np.meshgrid(np.linspace(0, 64, 65), np.linspace(0, 48, 49))
    x, y = undistort((u - 30) / 55, (v - 25) / 60, lens)
    mx, my = JACOBIAN_MARGIN * 64 / 110, JACOBIAN_MARGIN * 48 / 120
    found = (-domain.left, domain.right, -domain.top, domain.bottom)
    assert found == pytest.approx((x.min() - mx, x.max() + mx, y.min() - my, y.max() + my), abs=1e-3)
    assert find_valid_domain(Cameras.from_poses([np.eye(4)], [replace(at, distortion=())]), 0) is None


@dataclass(frozen=True)
class Seen:
    frame: int
    chunk_SE3_camera: np.ndarray
    lens: Lens


def _graph(splats: Splats) -> SceneGraph:
    g = Gaussians(splats.means, splats.scales.log(), splats.quats, splats.opacities.logit(), splats.colors)
    return SceneGraph(g, torch.zeros(len(splats), dtype=torch.int64), ())


def test_a_view_is_rendered_through_its_lens():
    splats, _ = street(2000, 64, 48)
    lens = Lens(50.0, 50.0, 32.0, 24.0, 64, 48)
    views = [Seen(0, np.eye(4), lens), Seen(0, np.eye(4), replace(lens, distortion=BARREL))]
    plain, curved = render_views(_graph(splats), views, CPU).color
    assert torch.equal(plain, render_views(_graph(splats), views[:1], CPU).color[0])
    assert (plain - curved).abs().max() > 0.1


def test_surfaces_meet_the_rays_of_the_lens():
    x, z = torch.meshgrid(torch.arange(-15, 15, 0.5), torch.arange(1, 40, 0.5), indexing="ij")
    n = x.numel()
    means = torch.stack([x.reshape(-1), torch.full((n,), 1.6), z.reshape(-1)], 1)
    scales = torch.tensor([0.35, 0.01, 0.35]).expand(n, 3)
    road = Splats(means, scales, torch.tensor([[1.0, 0, 0, 0]]).repeat(n, 1), torch.full((n,), 0.95), means * 0 + 0.5)
    lens = Lens(80.0, 80.0, 48.0, 32.0, 96, 64, (-0.2, 0.02, 0.0, 0.0, 0.0))
    depth = render_surfaces(_graph(road), [Seen(0, np.eye(4), lens)], CPU).expected_depth()[0]
    v, u = np.meshgrid(np.arange(40, 60) + 0.5, np.arange(18, 78) + 0.5, indexing="ij")
    _, y = undistort((u - 48) / 80, (v - 32) / 80, lens.coefficients)
    assert np.abs(depth[40:60, 18:78].numpy() * y / 1.6 - 1).max() < 0.01


def test_faulty_coefficients_and_missing_gradients_are_named(scene):
    splats, cameras = scene(5)
    with pytest.raises(ValueError, match=r"expected distortion of shape \(1, 5\), got \(1, 4\)"):
        render(splats, replace(cameras, distortion=torch.zeros(1, 4)))
    table = torch.tensor([BARREL], requires_grad=True)
    with pytest.raises(ValueError, match="backend cpu has no gradient in distortion; use reference"):
        render(splats, replace(cameras, distortion=table))
