"""A rolling shutter: against images put together of rows, the float64 reference, and finite differences."""

from __future__ import annotations

import inspect
import math
import sys
from dataclasses import dataclass, replace
from enum import Enum
from types import ModuleType

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from genre_tasks.errors import ConfigError, NonFiniteError, ResourceError
from genre_tasks.logs.types import Lens, RollingShutter
from genre_tasks.render import Cameras, RenderSettings, constants, render, render_views
from genre_tasks.render.cuda import _camera_options
from genre_tasks.render.reference_camera import ReferenceCamera
from genre_tasks.render.types import Shutter
from genre_tasks.scene import projection
from genre_tasks.scene.actor_node import ActorNode
from genre_tasks.scene.gaussians import Gaussians, Splats
from genre_tasks.scene.graph import FIRST_ACTOR, SceneGraph
from tests.render.oracles import agreement, relative_l2, survey
from tests.scenes import NAMES, cloud, pose_gradient_error, smooth, twist

CPU, REFERENCE = RenderSettings("cpu", 1), RenderSettings("reference")
BOTH = pytest.mark.parametrize("settings", [CPU, REFERENCE], ids=lambda s: s.backend)
BARREL = (-0.3, 0.12, 0.002, -0.0015, -0.01)
MOTION = RollingShutter(0.03, velocity_m_s=(9.0, -0.5, 14.0), turn_rad_s=(0.2, -0.5, 0.3))


def rolling(cameras: Cameras, how: RollingShutter = MOTION) -> Cameras:
    return replace(cameras, shutter=Shutter.from_rolling_shutters([how] * len(cameras), cameras.focal_px.dtype))


def drifting(splats: Splats, speed: float = 8.0) -> Splats:
    g = torch.Generator().manual_seed(2)
    return replace(splats, velocities=speed * torch.randn(len(splats), 3, generator=g).to(splats.means))


def _kind(splats: Splats, cameras: Cameras, kind: str) -> tuple[Splats, Cameras]:
    if "lens" in kind:
        cameras = replace(cameras, distortion=torch.tensor(BARREL).repeat(len(cameras), 1))
    return drifting(splats) if "own motion" in kind else splats, rolling(cameras)


KINDS = pytest.mark.parametrize("kind", ["camera", "camera, lens", "camera, own motion", "camera, lens, own motion"])


@KINDS
@pytest.mark.parametrize(("width", "height"), [(64, 48), (33, 17)])
def test_values_and_gradients_against_the_reference(scene, gradients, width, height, kind):
    splats, cameras = _kind(*scene(300, width, height, views=2), kind)
    image, grads = gradients(splats, cameras, CPU)
    truth, exact = gradients(splats, cameras, REFERENCE, torch.float64)
    assert image.culled == truth.culled
    still = render(splats, replace(cameras, shutter=None), CPU)
    assert (still.color - image.color).detach().abs().max() > 0.05
    found = agreement(image, truth, survey(splats, cameras).band)
    assert found.outside < 1e-5 and found.share < 0.02
    for name, grad in grads.items():
        assert relative_l2(grad, exact[name]) <= 1e-5, name


@KINDS
def test_reference_gradients_against_finite_differences(kind):
    splats, cameras = _kind(*smooth(), kind)
    assert cameras.shutter is not None
    shutter = [x.double().requires_grad_() for x in vars(cameras.shutter).values()]
    names = [*NAMES, *(["velocities"] if splats.velocities is not None else [])]
    inputs = [getattr(splats, n).requires_grad_() for n in names]

    def images(*x: torch.Tensor) -> torch.Tensor:
        moved = Splats(**dict(zip(names, x, strict=False)))
        out = render(moved, replace(cameras, shutter=Shutter(*x[len(names) :])), REFERENCE)
        return torch.cat([out.color.flatten(), out.alpha.flatten(), out.depth.flatten()])[::37]

    assert torch.autograd.gradcheck(images, inputs + shutter, eps=1e-6, atol=1e-6)


@pytest.mark.parametrize(("settings", "dtype", "bound"), [(CPU, torch.float32, 1e-5), (REFERENCE, torch.float64, 1e-7)])
def test_pose_gradient_against_finite_differences(settings, dtype, bound):
    splats, cameras = smooth()
    assert pose_gradient_error(splats, rolling(cameras), settings, dtype) < bound


def test_a_pose_gradient_leaves_the_image_of_what_moves(scene):
    splats, cameras = _kind(*scene(200), "own motion")
    pose = cameras.camera_SE3_chunk.clone().requires_grad_()
    image = render(splats, cameras, CPU)
    assert torch.allclose(render(splats, replace(cameras, camera_SE3_chunk=pose), CPU).color, image.color, atol=2e-5)
    assert not torch.allclose(render(replace(splats, velocities=None), cameras, CPU).color, image.color, atol=1e-2)


@BOTH
def test_no_readout_is_no_shutter_to_the_bit(scene, gradients, settings):
    splats, cameras = scene(300, views=2)
    plain, grads = gradients(splats, cameras, settings)
    for moved in (splats, drifting(splats)):
        still, same = gradients(moved, rolling(cameras, replace(MOTION, readout_s=0.0)), settings)
        assert all(torch.equal(getattr(plain, n), getattr(still, n)) for n in ("color", "alpha", "depth"))
        assert all(torch.equal(grads[n], same[n]) for n in grads) and still.culled == plain.culled


@BOTH
def test_what_moves_with_the_camera_stands_still(scene, settings):
    splats, cameras = scene(300)
    moving = rolling(cameras, RollingShutter(0.03, velocity_m_s=(9.0, -0.5, 14.0), turn_rad_s=(0.0, 0.0, 0.0)))
    own = torch.tensor([9.0, -0.5, 14.0]) @ cameras.camera_SE3_chunk[0, :3, :3]
    carried = replace(splats, velocities=own.expand(len(splats), 3))
    plain = render(splats, cameras, settings)
    assert (render(carried, moving, settings).color - plain.color).abs().max() < 1e-4
    assert (render(splats, moving, settings).color - plain.color).abs().max() > 0.05


def test_views_of_one_call_are_as_alone_at_any_thread_count(scene, gradients):
    splats, cameras = scene(300, views=3)
    shutters = [MOTION, None, replace(MOTION, readout_s=0.1)]
    cameras = replace(cameras, shutter=Shutter.from_rolling_shutters(shutters))
    together, grads = gradients(drifting(splats), cameras, CPU)
    assert torch.equal(together.color[1], render(splats, replace(cameras.select([1]), shutter=None), CPU).color[0])
    for v in range(3):
        assert torch.equal(render(drifting(splats), cameras.select([v]), CPU).color[0], together.color[v])
    again, same = gradients(drifting(splats), cameras, RenderSettings("cpu", 3))
    assert torch.equal(again.color, together.color) and all(torch.equal(grads[n], same[n]) for n in grads)


def _pose_after(cameras: Cameras, time_s: float, how: RollingShutter = MOTION) -> Cameras:
    xi = torch.tensor([*how.turn_rad_s, *how.velocity_m_s], dtype=torch.float64) * -time_s
    pose = torch.linalg.matrix_exp(twist(xi)) @ cameras.camera_SE3_chunk[0].double()
    return replace(cameras, camera_SE3_chunk=pose[None], shutter=None)


@BOTH
@pytest.mark.parametrize("distortion", [None, BARREL], ids=["pinhole", "lens"])
def test_each_row_is_seen_from_where_the_camera_then_is(scene, settings, distortion):
    """The truth: row r of the image that a global shutter takes (r + ½) / H − ½ of the readout later."""
    splats, cameras = scene(2000, 64, 48)
    if distortion is not None:
        cameras = replace(cameras, distortion=torch.tensor([distortion]))
    rows = []
    for r in range(48):
        time = ((r + 0.5) / 48 - 0.5) * MOTION.readout_s
        rows.append(render(splats, _pose_after(cameras, time), CPU).color[:, r])
    truth = torch.stack(rows, 1)
    rolled, still = render(splats, rolling(cameras), settings).color, render(splats, cameras, settings).color
    wrong, left = (still - truth).square().mean().sqrt(), (rolled - truth).square().mean().sqrt()
    assert wrong > 0.04 and left < wrong / 10


@pytest.mark.parametrize("distortion", [None, BARREL], ids=["pinhole", "lens"])
def test_one_newton_step_finds_the_row(distortion):
    """The row at which a point arrives is the one that is exposed then, up to the change of the row's speed."""
    table = None if distortion is None else torch.tensor([distortion])
    lens = torch.full((1, 2), 930.0), torch.tensor([[960.0, 540.0]])
    cameras = rolling(Cameras(torch.eye(4)[None], *lens, 1920, 1080, table))
    camera = ReferenceCamera(cameras, 0, torch.zeros((), dtype=torch.float64))
    g = torch.Generator().manual_seed(3)
    posed = (torch.rand(500, 3, generator=g, dtype=torch.float64) * 2 - 1) * torch.tensor([8.0, 4.0, 0.0])
    posed[:, 2] = 8 + 30 * torch.rand(500, generator=g, dtype=torch.float64)
    pixels = camera.to_pixels(*camera.move_to_exposure(posed, None).unbind(1))
    before = camera.to_pixels(*posed.unbind(1))
    moved = pixels - before
    motion = (camera.move_to_exposure(posed, None) - posed).norm(dim=1)
    speed = torch.tensor(MOTION.velocity_m_s).double() + torch.linalg.cross(
        torch.tensor(MOTION.turn_rad_s).double().expand_as(posed), posed
    )
    time = motion / speed.norm(dim=1) * torch.sign(before[:, 1] - 540)
    inside = (pixels[:, 1] > 0) & (pixels[:, 1] < 1080)
    late_px = (time * 1080 / MOTION.readout_s + 540 - pixels[:, 1])[inside]
    assert int(inside.sum()) > 300 and moved.abs().max() > 8
    assert late_px.abs().max() < 1.5, "a row is 28 µs, in which the image moves by less than 0.1 px"


@BOTH
def test_points_that_outrun_the_rows_stay_within_the_readout(scene, gradients, settings):
    """Towards the camera at the rows' own speed and faster: the divisor is limited, value and gradient stay finite."""
    splats, cameras = scene(100)
    for speed in (1e2, 1e3, 1e4, -1e4):
        how = RollingShutter(0.03, velocity_m_s=(0.0, -speed, 0.0), turn_rad_s=(0.0, 0.0, 0.0))
        out, grads = gradients(splats, rolling(cameras, how), settings)
        assert all(torch.isfinite(x).all() for x in (out.color, out.alpha, out.depth, *grads.values()))
    camera = ReferenceCamera(
        rolling(cameras, RollingShutter(0.03, velocity_m_s=(0.0, -1e4, 0.0), turn_rad_s=(0.0,) * 3)), 0, splats.means
    )
    posed = camera.to_camera(splats.means)
    moved = (camera.move_to_exposure(posed, None) - posed).norm(dim=1)
    assert float(moved.max()) <= 1e4 * 0.015 * (1 + 1e-4)


@pytest.mark.parametrize("distortion", [(), BARREL], ids=["pinhole", "lens"])
def test_points_are_projected_to_the_centres_of_gaussians(distortion):
    lens = Lens(55.0, 60.0, 31.0, 25.0, 64, 48, distortion)
    g = np.random.default_rng(4)
    points = (g.uniform(-1, 1, (400, 3)) * [6, 5, 12] + [0, 0, 10]).astype(np.float32)
    pose = np.linalg.inv(torch.linalg.matrix_exp(twist(torch.tensor([0.1, 0.2, -0.1, 0.3, 0.1, 0.2]))).double().numpy())
    seen = projection.project(points, pose, lens, MOTION)
    camera = ReferenceCamera(
        Cameras.from_poses([pose], [lens], torch.float64, [MOTION]), 0, torch.zeros((), dtype=torch.float64)
    )
    exposed = camera.move_to_exposure(camera.to_camera(torch.from_numpy(points).double()), None)
    pixels = camera.to_pixels(*exposed.unbind(1)).numpy()
    assert len(seen.index) > 100
    assert np.abs(pixels[seen.index] - seen.uv).max() < 1e-3
    assert np.allclose(exposed[seen.index, 2], seen.depth, rtol=1e-5)
    still = projection.project(points, pose, lens)
    both = np.intersect1d(still.index, seen.index)
    shift = seen.uv[np.searchsorted(seen.index, both)] - still.uv[np.searchsorted(still.index, both)]
    assert np.abs(shift).max() > 1
    none = projection.project(points, pose, lens, replace(MOTION, readout_s=0.0))
    assert np.array_equal(none.uv, still.uv) and np.array_equal(none.index, still.index)
    assert projection.SHUTTER_MIN_RATE == constants.SHUTTER_MIN_RATE


LENS = Lens(45.0, 45.0, 32.0, 24.0, 64, 48)


def _logits(splats: Splats) -> Gaussians:
    return Gaussians(splats.means, splats.scales.log(), splats.quats, splats.opacities.logit(), splats.colors)


@dataclass(frozen=True)
class Seen:
    frame: int
    chunk_SE3_camera: np.ndarray
    lens: Lens
    shutter: RollingShutter | None = None


def test_views_say_their_shutter(scene):
    splats, _ = scene(300)
    graph = SceneGraph(_logits(splats), torch.zeros(300, dtype=torch.int64), ())
    still, rolled = Seen(0, np.eye(4), LENS), Seen(0, np.eye(4), LENS, MOTION)
    both = render_views(graph, [still, rolled], CPU).color
    assert torch.equal(both[0], render_views(graph, [still], CPU).color[0])
    assert torch.equal(both[1], render_views(graph, [rolled], CPU).color[0])
    assert (both[0] - both[1]).abs().max() > 0.02


def _driving(count: int = 200) -> SceneGraph:
    """Half of the Gaussians are still, half on an actor that crosses the view at 12 m/s and turns at 1 rad/s."""
    splats = cloud(count)[0]
    nodes = torch.where(torch.arange(count) % 2 == 0, 0, FIRST_ACTOR)
    means = torch.where(nodes[:, None] > 0, splats.means * torch.tensor([0.1, 0.1, 0.05]), splats.means)
    splats = replace(splats, means=means, scales=splats.scales.clamp(max=0.4))
    poses = np.stack([_actor_pose(0.1 * f) for f in range(5)])
    actor = ActorNode("a", "car", (4.0, 2.0, 1.5), np.arange(5), poses)
    return SceneGraph(_logits(splats), nodes, (actor,))


def _actor_pose(time_s: float) -> np.ndarray:
    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_rotvec([0, time_s, 0]).as_matrix()
    pose[:3, 3] = 12.0 * time_s - 2.4, 0.5, 8.0
    return pose


PARKED = RollingShutter(0.06, velocity_m_s=(0.0, 0.0, 0.0), turn_rad_s=(0.0, 0.0, 0.0), frame_s=0.1)


@pytest.mark.parametrize("frame", range(5))
def test_actors_move_on_as_from_frame_to_frame(frame):
    scene = _driving()
    posed, moving = scene.gaussians_at_frames([frame])
    velocities = scene.velocities_at_frames(posed.means, [frame], [0.1])
    still = len(scene) - len(moving)
    assert not velocities[:still].any() and len(moving) == 100
    step = 1e-4
    after = replace(scene.actors[0], chunk_SE3_box=np.stack([_actor_pose(0.1 * f + step) for f in range(5)]))
    moved = replace(scene, actors=(after,)).gaussians_at_frames([frame])[0].means
    expected = (moved.double() - posed.means.double())[still:] / step
    # One-sided at the ends of the path: the turn's direction is that of 0.05 s off.
    assert (velocities[still:] - expected).abs().max() < 0.3 and expected.abs().max() > 12
    at = scene.gaussians_at(frame).means
    assert torch.equal(scene.velocities_at(at, frame, 0.1)[moving], velocities[still:])
    assert (
        not scene.velocities_at(at, frame, 0.0).any()
        and not scene.velocities_at_frames(posed.means, [frame], [0.0]).any()
    )


def test_an_actor_is_rendered_as_it_moves_during_the_readout():
    """The truth: row r of the image of the scene with the actor where it is at the row's time."""
    scene, view = _driving(), Seen(2, np.eye(4), LENS, PARKED)
    rows = []
    for r in range(48):
        time = 0.2 + ((r + 0.5) / 48 - 0.5) * PARKED.readout_s
        then = replace(scene.actors[0], chunk_SE3_box=np.stack([_actor_pose(time)] * 5))
        rows.append(render_views(replace(scene, actors=(then,)), [Seen(2, np.eye(4), LENS)], CPU).color[:, r])
    truth = torch.stack(rows, 1)
    rolled = render_views(scene, [view], CPU).color
    resting = render_views(scene, [replace(view, shutter=replace(PARKED, frame_s=0.0))], CPU).color
    wrong, left = (resting - truth).square().mean().sqrt(), (rolled - truth).square().mean().sqrt()
    assert wrong > 0.01 and left < wrong / 6, (wrong, left)
    assert torch.equal(resting, render_views(scene, [Seen(2, np.eye(4), LENS)], CPU).color), "a parked camera"


def test_an_actor_of_one_frame_rests_and_an_absent_one_too():
    scene = _driving()
    one = replace(scene.actors[0], frames=np.array([2]), chunk_SE3_box=scene.actors[0].chunk_SE3_box[2:3])
    for frame in (2, 3):
        assert not any(x.any() for x in one.motion(frame))


def test_views_of_a_frame_agree_on_the_time_to_the_next():
    scene = _driving()
    views = [Seen(2, np.eye(4), LENS, PARKED), Seen(2, np.eye(4), LENS, replace(PARKED, frame_s=0.2))]
    with pytest.raises(ValueError, match=r"expected one frame_s at frame 2, got 0\.1 and 0\.2"):
        render_views(scene, views, CPU)
    other = [Seen(3, np.eye(4), LENS, PARKED), Seen(2, np.eye(4), LENS), views[0]]
    together = render_views(scene, other, CPU).color
    assert torch.equal(together[0], render_views(scene, other[:1], CPU).color[0])
    assert torch.equal(together[2], render_views(scene, other[2:], CPU).color[0])


@BOTH
def test_velocities_that_are_not_finite_cull_their_gaussian(scene, gradients, settings):
    splats, cameras = scene(40, views=2)
    splats = drifting(splats)
    assert splats.velocities is not None
    splats.velocities[7, 1] = math.nan
    assert render(splats, cameras, settings).culled == {}, "without a shutter nobody asks"
    out, grads = gradients(splats, rolling(cameras), settings)
    assert out.culled == {"non_finite": 2} and not any(bool(g[7].any()) for g in grads.values())
    assert all(torch.isfinite(g).all() for g in grads.values())


def test_faulty_shutters_and_missing_gradients_are_named(scene):
    splats, cameras = scene(5)
    rolled = rolling(cameras)
    assert rolled.shutter is not None
    with pytest.raises(ValueError, match=r"expected turn_rad_s of shape \(1, 3\), got \(1, 2\)"):
        render(splats, replace(rolled, shutter=replace(rolled.shutter, turn_rad_s=torch.zeros(1, 2))))
    with pytest.raises(ValueError, match="expected readout_s of at least 0"):
        render(splats, rolling(cameras, replace(MOTION, readout_s=-0.01)))
    with pytest.raises(NonFiniteError) as caught:
        render(splats, rolling(cameras, replace(MOTION, velocity_m_s=(0.0, math.nan, 0.0))))
    assert caught.value.tensor == "velocity_m_s" and caught.value.first_index == (0, 1)
    with pytest.raises(ValueError, match=r"expected velocities of shape \(5, 3\), got \(4, 3\)"):
        render(replace(splats, velocities=torch.zeros(4, 3)), rolled)
    with pytest.raises(ValueError, match="backend cpu has no gradient in velocities; use reference"):
        render(replace(splats, velocities=torch.zeros(5, 3, requires_grad=True)), rolled)


class _Sides(Enum):
    ROLLING_TOP_TO_BOTTOM = 0


@pytest.fixture
def gsplat(monkeypatch) -> ModuleType:
    """A stand-in for the package."""
    module = ModuleType("gsplat")
    module.RollingShutterType = _Sides
    monkeypatch.setitem(sys.modules, "gsplat", module)
    return module


def test_gsplat_is_told_of_lens_and_shutter(scene, gsplat):
    splats, cameras = scene(5)
    assert _camera_options(splats, cameras) == {}, "a pinhole camera takes the plain way"
    assert _camera_options(splats, rolling(cameras, replace(MOTION, readout_s=0.0))) == {}
    told = _camera_options(splats, replace(rolling(cameras), distortion=torch.tensor([BARREL])))
    assert told["with_ut"] and told["with_eval3d"]
    k1, k2, p1, p2, k3 = BARREL
    assert told["radial_coeffs"].tolist() == [pytest.approx([k1, k2, k3, 0, 0, 0])]
    assert told["tangential_coeffs"].tolist() == [pytest.approx([p1, p2])]
    assert told["rolling_shutter"] is _Sides.ROLLING_TOP_TO_BOTTOM
    half = MOTION.readout_s / 2 * 47 / 48  # from the first row's centre to the last one's
    for name, time in (("viewmats", -half), ("viewmats_rs", half)):
        expected = _pose_after(cameras, time).camera_SE3_chunk
        assert torch.allclose(told[name].double(), expected, atol=1e-3), name
        assert not torch.allclose(told[name].double(), cameras.camera_SE3_chunk.double(), atol=0.1)


def test_gsplat_takes_what_it_is_told(scene):
    gsplat = pytest.importorskip("gsplat", reason="gsplat is not installed")
    splats, cameras = scene(5)
    told = _camera_options(splats, replace(rolling(cameras), distortion=torch.tensor([BARREL])))
    assert set(told) <= set(inspect.signature(gsplat.rasterization).parameters)


def test_what_gsplat_cannot_is_refused(scene, gsplat):
    splats, cameras = scene(5)
    assert _camera_options(drifting(splats), cameras) == {}
    with pytest.raises(ConfigError, match=r"cannot move Gaussians during a readout.*backend cpu"):
        _camera_options(drifting(splats), rolling(cameras))
    pose = cameras.camera_SE3_chunk.clone().requires_grad_()
    with pytest.raises(ValueError, match="no gradient in camera_SE3_chunk with a distortion or a shutter"):
        _camera_options(splats, rolling(replace(cameras, camera_SE3_chunk=pose)))
    del gsplat.RollingShutterType
    with pytest.raises(ResourceError, match=r"renders neither lens distortion nor rolling shutter.*gsplat>=1.5.3"):
        _camera_options(splats, rolling(cameras))
