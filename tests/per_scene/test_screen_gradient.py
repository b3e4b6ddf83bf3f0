"""The gradient on the image from the mean's gradient, against the reference renderer's own projected centres."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch

from genre_tasks.logs.types import Lens
from genre_tasks.per_scene.screen_gradient import screen_space_gradient
from genre_tasks.render import Cameras, reference
from genre_tasks.render.reference_camera import ReferenceCamera
from genre_tasks.scene.gaussians import Splats
from tests.optimiser import street_scenes

WIDE = Lens(100.0, 90.0, 70.0, 40.0, 128, 96)


def _truth(splats: Splats, pose: torch.Tensor, lens: Lens, monkeypatch: pytest.MonkeyPatch) -> torch.Tensor:
    """‖dL/du‖ [N] by autograd: the reference renderer with a zero added to its projected centres."""
    nudge = torch.zeros(len(splats), 2, dtype=splats.means.dtype, requires_grad=True)
    geometry = reference._project_geometry

    def nudged(splats: Splats, camera: ReferenceCamera, rows: torch.Tensor):
        found = geometry(splats, camera, rows)
        return replace(found, center=found.center + nudge[rows])

    with monkeypatch.context() as patch:
        patch.setattr(reference, "_project_geometry", nudged)
        _loss(splats, pose, lens).backward()
    assert nudge.grad is not None
    return (nudge.grad * torch.tensor([lens.width_px / 2, lens.height_px / 2])).norm(dim=1)


def _loss(splats: Splats, pose: torch.Tensor, lens: Lens) -> torch.Tensor:
    (color, _, _), _ = reference.render_reference(splats, Cameras.from_poses([pose.numpy()], [lens], torch.float64))
    wanted = torch.rand(color.shape, generator=torch.Generator().manual_seed(5), dtype=color.dtype)
    return (color - wanted).abs().mean()


def _pose() -> torch.Tensor:
    """Turned and moved, so that camera and chunk axes differ."""
    pose = torch.eye(4, dtype=torch.float64)
    c, s = math.cos(0.3), math.sin(0.3)
    pose[:3, :3] = torch.tensor([[c, 0, s], [0, 1, 0], [-s, 0, c]])
    pose[:3, 3] = torch.tensor([0.4, -0.2, 0.5])
    return pose


@pytest.mark.parametrize(("shrink", "typical", "worst"), [(3.0, 0.001, 0.005), (0.0, 0.04, 0.15)])
def test_the_screen_gradient_is_the_reference_renderers(
    shrink: float, typical: float, worst: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    g = street_scenes.scene(150, actor=False).gaussians
    splats = Splats(g.means, (g.log_scales - shrink).exp(), g.quats, torch.full((len(g),), 0.5), g.colors)
    splats = splats.to(torch.float64)
    splats.means.requires_grad_()
    _loss(splats, _pose(), WIDE).backward()
    assert splats.means.grad is not None
    largest = splats.scales.amax(1)
    screen_gradient, visible = screen_space_gradient(
        splats.means.detach(), splats.means.grad, largest, _pose().numpy(), WIDE
    )
    truth = _truth(splats, _pose(), WIDE, monkeypatch)
    strong = visible & (truth > truth[truth > 0].median())
    error = ((screen_gradient - truth).abs() / truth)[strong]
    assert int(strong.sum()) > 20
    assert float(error.median()) < typical and float(error.quantile(0.9)) < worst


def test_which_gaussians_are_in_view() -> None:
    """Ahead, behind, beside, beside but large enough to reach in, and ahead without any gradient."""
    means = torch.tensor([[0.0, 0, 5], [0, 0, -5], [20, 0, 5], [4, 0, 5], [0, 0, 6]])
    gradient = torch.ones(5, 3)
    gradient[4] = 0
    screen_gradient, visible = screen_space_gradient(
        means, gradient, torch.tensor([0.1, 0.1, 0.1, 0.5, 0.1]), street_scenes.pose(0.0), street_scenes.LENS
    )
    assert visible.tolist() == [True, False, False, True, True]
    assert float(screen_gradient[0]) == pytest.approx(math.hypot(5 / 40 * 24, 5 / 40 * 16))
    assert (screen_gradient > 0).tolist() == [True, False, False, True, False]
