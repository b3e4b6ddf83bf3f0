"""Motion blur: the mean in linear light of sharp images, with whatever else moves; exposure 0 is none."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
import pytest
import torch

from genre_tasks.logs.types import Lens, MotionBlur, RollingShutter
from genre_tasks.render import RenderSettings, cpu, render_views
from genre_tasks.render.motion_blur import (
    BLUR_SAMPLE_COUNT,
    BlurSamples,
    _decode_srgb,
    _encode_srgb,
    mean_in_linear_light,
    mean_in_linear_light_gradient,
)
from genre_tasks.scene.actor_node import ActorNode
from genre_tasks.scene.gaussians import Gaussians
from genre_tasks.scene.graph import SceneGraph
from genre_tasks.scene.transforms import compose_se3
from tests.optimiser import street_scenes
from tests.scenes import twist

BLUR = MotionBlur(0.08, velocity_m_s=(9.0, -0.5, 14.0), turn_rad_s=(0.2, -0.5, 0.3), frame_s=0.1)
ROLLING = RollingShutter(0.05, velocity_m_s=BLUR.velocity_m_s, turn_rad_s=BLUR.turn_rad_s, frame_s=0.1)
REFERENCE = RenderSettings("reference")


@dataclass(frozen=True)
class Seen:
    """A view of the tiny street."""

    frame: float = 0
    chunk_SE3_camera: np.ndarray = field(default_factory=lambda: street_scenes.pose(0.1))
    lens: Lens = street_scenes.LENS
    shutter: RollingShutter | None = None
    blur: MotionBlur | None = None


def _after(view: Seen, seconds: float) -> Seen:
    """Where the camera and the log are then; no blur."""
    way = twist(torch.tensor([*BLUR.turn_rad_s, *BLUR.velocity_m_s], dtype=torch.float64) * seconds)
    pose = view.chunk_SE3_camera @ torch.linalg.matrix_exp(way).numpy()
    return replace(view, frame=view.frame + seconds / 0.1, chunk_SE3_camera=pose, blur=None)


def _times(count: int) -> list[float]:
    return [((k + 0.5) / count - 0.5) * BLUR.exposure_s for k in range(count)]


def test_black_and_white_meet_at_half_the_light() -> None:
    image = torch.stack([torch.zeros(2, 2, 3), torch.ones(2, 2, 3)]).double()
    assert float(mean_in_linear_light(image)[0, 0, 0]) == pytest.approx(0.7354, abs=1e-4)
    values = torch.linspace(-0.2, 1.6, 500, dtype=torch.float64)
    torch.testing.assert_close(_encode_srgb(_decode_srgb(values)), values, atol=1e-6, rtol=0)
    same = values[None].expand(5, 500)
    torch.testing.assert_close(mean_in_linear_light(same), values, atol=1e-6, rtol=0)


@pytest.mark.parametrize("count", [1, 5])
def test_the_means_gradient_is_that_of_finite_differences(count: int) -> None:
    g = torch.Generator().manual_seed(0)
    color = torch.rand(count, 4, 5, 3, generator=g, dtype=torch.float64) * 1.4 - 0.2
    by_mean = torch.randn(4, 5, 3, generator=g, dtype=torch.float64)
    found = mean_in_linear_light_gradient(color, by_mean)
    step = 1e-6
    for way in (torch.randn(color.shape, generator=g, dtype=torch.float64) for _ in range(3)):
        apart = mean_in_linear_light(color + step * way) - mean_in_linear_light(color - step * way)
        assert float((found * way).sum()) == pytest.approx(float((by_mean * apart).sum()) / (2 * step), rel=1e-6)


@pytest.mark.parametrize("shutter", [None, ROLLING], ids=["global", "rolling"])
def test_a_blurred_view_is_the_mean_of_what_its_moments_see(shutter: RollingShutter | None) -> None:
    """Camera and actor are where they then are; alpha and depth are those at the pose's own time."""
    scene, view = street_scenes.scene(), Seen(shutter=shutter, blur=BLUR)
    sharp = [render_views(scene, [_after(view, t)]) for t in _times(BLUR_SAMPLE_COUNT)]
    image = render_views(scene, [view])
    torch.testing.assert_close(
        image.color[0], mean_in_linear_light(torch.cat([s.color for s in sharp])), atol=2e-5, rtol=0
    )
    plain = render_views(scene, [replace(view, blur=None)])
    assert torch.equal(image.alpha, plain.alpha) and torch.equal(image.depth, plain.depth)
    assert (image.color - plain.color).abs().max() > 0.05
    resting = render_views(scene, [replace(view, blur=replace(BLUR, frame_s=0.0))])
    assert (image.color - resting.color).abs().max() > 0.01


def test_five_moments_of_a_rolling_shutter_are_near_to_forty_images_put_together_of_rows() -> None:
    """The truth: each row of each moment is taken by a global shutter where the camera and the actor then are."""
    scene, view = street_scenes.scene(), Seen(shutter=ROLLING, blur=BLUR)
    rows = [[] for _ in range(view.lens.height_px)]
    for t in _times(8):
        for r, row in enumerate(rows):
            due = t + ((r + 0.5) / len(rows) - 0.5) * ROLLING.readout_s
            row.append(render_views(scene, [replace(_after(view, due), shutter=None)]).color[0, r])
    truth = torch.stack([mean_in_linear_light(torch.stack(row)) for row in rows])
    each = {
        "both": view,
        "shutter": replace(view, blur=None),
        "blur": replace(view, shutter=None),
        "neither": replace(view, blur=None, shutter=None),
    }
    off = {n: float((render_views(scene, [v]).color[0] - truth).square().mean().sqrt()) for n, v in each.items()}
    assert off["both"] < 0.35 * min(off[n] for n in ("shutter", "blur", "neither")), off


def test_views_without_blur_are_rendered_as_ever(monkeypatch: pytest.MonkeyPatch) -> None:
    """Exposure 0 too: the same bits, and the same kernel calls."""
    scene, plain = street_scenes.scene(), Seen(shutter=ROLLING)
    calls: list[int] = []
    real = cpu.forward
    monkeypatch.setattr(cpu, "forward", lambda *a, **k: calls.append(len(a[1])) or real(*a, **k))
    expected = render_views(scene, [plain, plain])
    still = [replace(plain, blur=replace(BLUR, exposure_s=0.0)), plain]
    assert BlurSamples.from_views(still) is None
    image = render_views(scene, still)
    assert all(torch.equal(getattr(image, n), getattr(expected, n)) for n in ("color", "alpha", "depth"))
    assert calls == [2, 2]
    mixed = render_views(scene, [plain, replace(plain, blur=BLUR)])
    assert calls == [2, 2, 1 + BLUR_SAMPLE_COUNT] and torch.equal(mixed.color[0], expected.color[0])


def test_the_same_bits_at_any_thread_count() -> None:
    scene, view, results, before = street_scenes.scene(), Seen(blur=BLUR), [], torch.get_num_threads()
    try:
        for threads in (1, 2, 3):
            torch.set_num_threads(threads)
            colors = scene.gaussians.colors.clone().requires_grad_()
            image = render_views(scene.with_gaussians(replace(scene.gaussians, colors=colors)), [view])
            image.color.square().sum().backward()
            results.append((image.color.detach(), colors.grad))
    finally:
        torch.set_num_threads(before)
    assert all(torch.equal(a, b) for r in results[1:] for a, b in zip(results[0], r, strict=True))


@pytest.mark.parametrize("shutter", [None, ROLLING], ids=["global", "rolling"])
def test_gradients_of_a_blurred_view_against_finite_differences(shutter: RollingShutter | None) -> None:
    """In float64 by the reference, and in float32 by the kernel."""
    scene, view = street_scenes.scene(20), Seen(shutter=shutter, blur=replace(BLUR, exposure_s=0.02))
    soft = replace(scene.gaussians, log_scales=scene.gaussians.log_scales + 2.7)  # no footprint ends in the image
    soft = replace(soft, logit_opacities=torch.full_like(soft.logit_opacities, -1.5))
    packed = soft.pack().double()
    g = torch.Generator().manual_seed(1)
    weight = torch.randn(street_scenes.LENS.height_px, street_scenes.LENS.width_px, 3, generator=g).double()

    def loss(at: torch.Tensor, settings: RenderSettings = REFERENCE) -> torch.Tensor:
        image = render_views(scene.with_gaussians(Gaussians.unpack(at)), [view], settings)
        return (image.color[0] * weight.to(image.color)).sum()

    found = {}
    for name, leaf, settings in (
        ("exact", packed, REFERENCE),
        ("kernel", packed.float(), RenderSettings("cpu", 1)),
    ):
        leaf = leaf.clone().requires_grad_()
        loss(leaf, settings).backward()
        found[name] = leaf.grad.double()
    assert float((found["kernel"] - found["exact"]).norm() / found["exact"].norm()) < 1e-4
    step = 1e-6
    with torch.no_grad():
        for columns in ((0, 3), (3, 6), (6, 10), (10, 11), (11, 14)):
            way = torch.zeros_like(packed)
            way[:, slice(*columns)] = torch.randn(len(packed), columns[1] - columns[0], generator=g).double()
            slope = float(loss(packed + step * way) - loss(packed - step * way)) / (2 * step)
            assert float((found["exact"] * way).sum()) == pytest.approx(slope, rel=1e-5), columns


def test_an_actor_between_frames_is_on_its_way() -> None:
    turns = np.stack([np.eye(3), [[0, -1, 0], [1, 0, 0], [0, 0, 1.0]]])
    actor = ActorNode(
        "a", "Car", (1.0, 1.0, 1.0), np.array([3, 4]), compose_se3(turns, np.array([[1.0, 0, 0], [3.0, 0, 0]]))
    )
    assert np.array_equal(actor.pose(3.0), actor.chunk_SE3_box[0])
    quarter = actor.pose(3.25)
    np.testing.assert_allclose(quarter[:3, 3], [1.5, 0, 0])
    np.testing.assert_allclose(quarter[:3, 0], [np.cos(np.pi / 8), np.sin(np.pi / 8), 0], atol=1e-12)
    np.testing.assert_allclose(actor.pose(3.75)[:3, 3], [2.5, 0, 0])
    assert actor.pose(2.6) is not None and actor.pose(2.4) is None
    scene = SceneGraph(street_scenes.scene().gaussians, torch.full((300,), 2), (actor,))
    assert not torch.equal(scene.gaussians_at(3.25).means, scene.gaussians_at(3).means)
