"""What is on is applied, to the gradient and back; what is off costs nothing and changes no bit."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
import torch

from genre_tasks.config import (
    EffectsConfig,
    GnetConfig,
    IngestConfig,
    InitialConfig,
    LossConfig,
    NovelViewsConfig,
    PerSceneConfig,
)
from genre_tasks.effects.apply_plan import apply_plan, move_views
from genre_tasks.effects.ego_mask import fit as fit_ego_mask
from genre_tasks.effects.measurements import ChunkMeasurements
from genre_tasks.effects.plan import EFFECT_NAMES, plan_effects
from genre_tasks.effects.types import DEFAULT_PLAN, Decision, EffectParameters, EffectsPlan
from genre_tasks.errors import ConfigError
from genre_tasks.fixer.source_images import load_source_images
from genre_tasks.fixer.view_surface import unproject_surface
from genre_tasks.fixer.warping import SourceImage, sample_source
from genre_tasks.logs.registry import open_log
from genre_tasks.logs.synthetic.camera_effects import bonnet_mask
from genre_tasks.logs.synthetic.parameters import StreetParameters
from genre_tasks.losses.exposed_renders import ExposedRenders
from genre_tasks.losses.rendering_loss import image_gradients, select_loss_terms
from genre_tasks.losses.targets import Target, view_targets
from genre_tasks.metrics.scoring import decode_view_image
from genre_tasks.metrics.view_scores import score_views
from genre_tasks.render import cpu
from genre_tasks.render.motion_blur import BlurSamples, mean_in_linear_light
from genre_tasks.scene.chunk import Chunk
from genre_tasks.scene.novel_poses import place_novel_views
from genre_tasks.scene.visibility import GREY
from genre_tasks.stages.gnet import gnet
from genre_tasks.stages.ingest import ingest
from genre_tasks.stages.initial import initial
from genre_tasks.stages.novel_views import novel_views
from genre_tasks.stages.planned_losses import drop_unplanned_losses
from tests.effects.imports import assert_imports_no_effect

SMALL = "&frames=8&cameras=2&width=160&height=90&samples=1"
STREET = "synthetic:street?seed=1020" + SMALL
SHIFT = np.array([[1.0, 0, 0, 0.5], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]])


@cache
def chunk(uri: str = STREET) -> Chunk:
    return ingest(IngestConfig(width_px=160, height_px=90), open_log(uri), 0)


def with_(*on: str, parameters: EffectParameters | None = None) -> EffectsPlan:
    rows = [Decision(n, "", 1.0, "", 0.0, "auto", "on" if n in on else "off", "", "") for n in EFFECT_NAMES]
    return EffectsPlan(tuple(rows), parameters or EffectParameters())


DEFAULT_EFFECTS = ("rigid_actors", "distant_region", "lidar_depth")


def test_a_plan_without_anything_to_apply_leaves_the_chunk_itself() -> None:
    assert apply_plan(chunk(), DEFAULT_PLAN) is chunk()
    assert apply_plan(chunk(), with_(*DEFAULT_EFFECTS)) is chunk()


def test_what_is_off_gives_the_same_bytes_as_no_plan() -> None:
    first = initial(InitialConfig(max_points=2000, distant_count=200), chunk())
    again = initial(InitialConfig(max_points=2000, distant_count=200), chunk(), with_(*DEFAULT_EFFECTS))
    assert torch.equal(first.scene.gaussians.pack(), again.scene.gaussians.pack())
    config = GnetConfig(iterations=3, views_per_iteration=2, method="adam", loss=LossConfig(perceptual=0))
    one, two = gnet(config, chunk(), first), gnet(config, chunk(), first, with_(*DEFAULT_EFFECTS))
    assert torch.equal(one.scene.gaussians.pack(), two.scene.gaussians.pack()) and one.losses == two.losses


def test_stages_of_a_plan_without_effects_import_none() -> None:
    code = (
        "import tests.effects.test_effects_plan as t\n"
        "from genre_tasks.effects.plan import EFFECT_NAMES, plan_effects\n"
        "from genre_tasks.config import *\n"
        "from genre_tasks.stages.initial import initial\n"
        "from genre_tasks.stages.gnet import gnet\n"
        "from genre_tasks.stages.novel_views import novel_views\n"
        "from genre_tasks.stages.evaluate import evaluate_scene\n"
        "none = plan_effects(EffectsConfig(**dict.fromkeys(EFFECT_NAMES, 'off')), t.chunk(), t.cameras())\n"
        "first = initial(InitialConfig(max_points=2000, distant_count=200), t.chunk(), none)\n"
        "config = GnetConfig(iterations=1, method='adam', loss=LossConfig(perceptual=0))\n"
        "scene = gnet(config, t.chunk(), first, none)\n"
        "novel_views(NovelViewsConfig(), t.chunk(), scene, none)\n"
        "judged = EvaluateConfig(distributions=False, shifts_m=(), pictures=0)\n"
        "evaluate_scene(judged, t.chunk(), 'gnet', scene, None, none)\n"
        "assert not (scene.scene.nodes > 0).any()\n"
    )
    assert_imports_no_effect(code)


def test_without_rigid_actors_their_points_stand_where_the_sweeps_saw_them() -> None:
    still = apply_plan(chunk(), with_("distant_region", "lidar_depth"))
    assert not still.actors
    assert len(still.static) == len(chunk().static) + sum(len(a.points) for a in chunk().actors)
    actor = chunk().actors[0]
    own = still.static.positions[len(chunk().static) : len(chunk().static) + len(actor.points)]
    at = int(actor.points.frames[0])
    pose = actor.chunk_SE3_box[list(actor.frames).index(at)]
    np.testing.assert_allclose(own[0], pose[:3, :3] @ actor.points.positions[0] + pose[:3, 3], atol=1e-4)


def test_without_the_depth_term_no_depth_pulls() -> None:
    config = GnetConfig(iterations=2, method="adam", loss=LossConfig(perceptual=0, depth=5.0))
    first = initial(InitialConfig(max_points=2000, distant_count=200), chunk())
    pulled = gnet(config, chunk(), first, with_(*DEFAULT_EFFECTS))
    left = gnet(config, chunk(), first, with_("rigid_actors", "distant_region"))
    assert left.losses[0] < pulled.losses[0]


def test_nothing_pulls_where_the_vehicle_itself_is() -> None:
    view = chunk().views_with_role("source")[0]
    own = np.zeros((90, 160), bool)
    own[70:] = True
    (target,) = view_targets(chunk(), [replace(view, ego_mask=own)])
    color = torch.rand(1, 90, 160, 3, generator=torch.Generator().manual_seed(2))
    config = LossConfig(perceptual=0)
    loss_plan = select_loss_terms(config, [target], 0, torch.Generator(), perceptual=False)
    renders = ExposedRenders.from_renders(color, [target])
    by_color = image_gradients(config, renders, torch.ones(1, 90, 160), loss_plan)[1]
    assert not by_color[0, 70:].any() and by_color[0, :60].any()
    # What is rendered there changes nothing beside it either, though windows of SSIM reach over the edge.
    other = torch.cat([color[:, :70], torch.zeros(1, 20, 160, 3)], 1)
    renders = ExposedRenders.from_renders(other, [target])
    assert torch.equal(image_gradients(config, renders, torch.ones(1, 90, 160), loss_plan)[1], by_color)
    assert not color[:, 70:].eq(0).all()
    images = torch.rand(1, 90, 160, 3, generator=torch.Generator().manual_seed(3))
    worse = images.clone()
    worse[:, 70:] = 0
    kept = [score_views([replace(view, ego_mask=own)], i, decode_view_image(view)[None])[0] for i in (images, worse)]
    assert kept[0] == kept[1]
    assert score_views([view], images, decode_view_image(view)[None])[0].psnr != kept[0].psnr


def test_the_streets_bonnet_is_found_where_it_is() -> None:
    uri = STREET + "&bonnet=0.08"
    log = open_log(uri)
    found = plan_effects(
        EffectsConfig(**{n: "auto" if n == "ego_mask" else "off" for n in EFFECT_NAMES}), chunk(uri), log.cameras
    )
    assert found["ego_mask"].choice == "on" and list(found.parameters.ego_masks) == ["front_camera"]
    lens = chunk(uri).views[0].lens
    true = bonnet_mask(StreetParameters(bonnet=0.08), "front_camera", lens)
    mask = found.parameters.ego_masks["front_camera"]
    assert (mask & true).sum() > 0.97 * true.sum() and (mask & ~true).sum() < 0.6 * true.sum()
    truth = log.truth.image(0, log.world_SE3_camera("front_camera", 0), lens).astype(float)
    image = decode_view_image(chunk(uri).views[0]).numpy() * 255
    assert np.abs(image - truth)[~true].max() <= 1 and np.abs(image - truth)[true].mean() > 20


def test_the_road_takes_no_colours_from_the_bonnet() -> None:
    uri = STREET + "&bonnet=0.08"
    found = _planned(uri, "ego_mask")
    rows = found.parameters.ego_points
    assert rows is not None and len(rows) > 50
    bonnet = chunk(uri).static
    clean = chunk(STREET).static
    # Both streets have the same points; a colour that differs by many levels is the bonnet's.
    assert np.array_equal(bonnet.positions, clean.positions)
    painted = np.abs(bonnet.colors.astype(int) - clean.colors).max(1) > 30
    assert np.isin(np.flatnonzero(painted), rows).mean() > 0.95
    applied = apply_plan(chunk(uri), found).static
    assert not applied.colored[rows].any() and (applied.colors[rows] == GREY).all()
    # Actors follow the background: their effect is off.
    rest = np.setdiff1d(np.arange(len(bonnet)), rows)
    assert np.array_equal(applied.colors[rest], bonnet.colors[rest])
    # Where the plan moved the views, the points are still those that ingest coloured.
    moved = move_views(chunk(uri), {(v.camera, v.frame): v.chunk_SE3_camera @ SHIFT for v in chunk(uri).views})
    measured = ChunkMeasurements(moved, open_log(uri).cameras, ingested=chunk(uri))
    assert np.array_equal(fit_ego_mask(measured).ego_points, rows)


def test_shutters_are_the_cameras_own_motion() -> None:
    uri = "synthetic:street?seed=1020&frames=8&cameras=2&width=160&height=90&samples=1&rolling_shutter_s=0.03"
    log = open_log(uri)
    found = _planned(uri, "rolling_shutter")
    shutters = found.parameters.shutters
    assert set(shutters) == {(v.camera, v.frame) for v in chunk(uri).views}
    for view in chunk(uri).views[2:-2]:
        near = [log.camera_effects.street_SE3_camera(view.camera, 0.1 * view.frame + s) for s in (-1e-3, 1e-3)]
        true = view.chunk_SE3_camera[:3, :3].T @ (near[1][:3, 3] - near[0][:3, 3]) / 2e-3
        shutter = shutters[view.camera, view.frame]
        assert np.abs(np.array(shutter.velocity_m_s) - true).max() < 0.05 and shutter.readout_s == 0.03
        assert shutter.frame_s == pytest.approx(0.1, rel=1e-4)
    view = apply_plan(chunk(uri), found).views[0]
    assert view.shutter == shutters[view.camera, view.frame]
    (target,) = view_targets(chunk(uri), [view])
    assert target.shutter == view.shutter
    assert float(np.linalg.norm(view.shutter.velocity_m_s)) > 3


def test_a_rolling_shutters_images_are_undone_by_what_the_plan_says() -> None:
    """Looked up at the true depth, recorded rows give what an ideal camera would have seen."""
    uri = (
        "synthetic:street?seed=1020&frames=8&cameras=3&width=160&height=90&rolling_shutter_s=0.1&moving=0&pedestrians=0"
    )
    log = open_log(uri)
    views = [
        v for v in apply_plan(chunk(uri), _planned(uri, "rolling_shutter")).views if v.camera == "front_right_camera"
    ]
    off = {True: [], False: []}
    for view in views[1:-1:2]:
        pose = chunk(uri).world_SE3_chunk @ view.chunk_SE3_camera
        depth = torch.tensor(log.depth(view.frame, pose, view.lens)).float()
        near = depth < 60
        surface = unproject_surface(depth * near, near.float(), view.chunk_SE3_camera, view.lens, (), view.frame)
        true = torch.tensor(log.truth.image(view.frame, pose, view.lens) / 255).float()
        for shutter in (True, False):
            image = decode_view_image(view).permute(2, 0, 1)
            rows = SourceImage(view.camera, view.frame, view.chunk_SE3_camera, view.lens, image, torch.zeros(90, 160))
            color, seen = sample_source(
                surface, replace(rows, shutter=view.shutter if shutter else None), (), view.frame
            )
            off[shutter].append(float((color.permute(1, 2, 0) - true).abs()[seen & near].mean()))
    assert np.mean(off[True]) < 0.65 * np.mean(off[False])  # what is left is blurred by resampling
    assert np.mean(off[False]) > 0.02


def _planned(uri: str, name: str) -> EffectsPlan:
    return plan_effects(
        EffectsConfig(**{n: "on" if n == name else "off" for n in EFFECT_NAMES}), chunk(uri), open_log(uri).cameras
    )


def test_a_lens_that_is_off_is_taken_to_be_straight() -> None:
    uri = STREET + "&distortion=0.1"
    bent = apply_plan(chunk(uri), with_(*DEFAULT_EFFECTS, "lens_distortion"))
    assert bent is chunk(uri) and apply_plan(chunk(uri), DEFAULT_PLAN) is chunk(uri)
    assert all(not v.lens.distortion for v in apply_plan(chunk(uri), with_(*DEFAULT_EFFECTS)).views)


def test_an_exposure_of_no_time_is_no_blur() -> None:
    """Hard case 54."""
    log, plain = open_log(STREET + "&exposure_s=0"), open_log(STREET)
    assert log.image_bytes("front_camera", 3) == plain.image_bytes("front_camera", 3)
    names = EffectsConfig(**{n: "auto" if n == "motion_blur" else "off" for n in EFFECT_NAMES})
    found = plan_effects(names, chunk(), log.cameras)["motion_blur"]
    assert found.choice == "off" and "no exposure time" in found.reason
    assert open_log(STREET + "&exposure_s=0.05").image_bytes("front_camera", 3) != plain.image_bytes("front_camera", 3)


def test_an_exposed_streets_images_are_the_mean_of_what_the_plans_moments_see() -> None:
    """Of sharp true images: nothing moves but the camera."""
    uri = STREET + "&exposure_s=0.05&moving=0&pedestrians=0"
    log = open_log(uri)
    views = [v for v in apply_plan(chunk(uri), _planned(uri, "motion_blur")).views if v.camera == "front_left_camera"]
    off: dict[str, list[float]] = {"moments": [], "pose": []}
    for view in views[1:-1:2]:
        moments = BlurSamples.from_views([view])
        assert view.blur is not None and view.blur.exposure_s == 0.05 and moments is not None
        assert view.blur.frame_s == pytest.approx(0.1) and float(np.linalg.norm(view.blur.velocity_m_s)) > 3
        poses = [chunk(uri).world_SE3_chunk @ v.chunk_SE3_camera for v in moments.views]
        true = torch.tensor(np.stack([log.truth.image(view.frame, p, view.lens) for p in poses]) / 255).float()
        for name, image in (("moments", mean_in_linear_light(true)), ("pose", true[len(true) // 2])):
            off[name].append(float((image - decode_view_image(view)).abs().mean()))
    assert np.mean(off["moments"]) < 0.4 * np.mean(off["pose"]), off


def test_a_camera_with_one_image_is_not_blurred() -> None:
    """No second image, no motion; what the log states of it is not enough."""
    uri = STREET + "&exposure_s=0.05"
    first = chunk(uri).views_with_role("source")[0]
    alone = replace(chunk(uri), views=(first, *(v for v in chunk(uri).views if v.camera != first.camera)))
    setting = EffectsConfig(**{n: "on" if n == "motion_blur" else "off" for n in EFFECT_NAMES})
    found = plan_effects(setting, alone, open_log(uri).cameras)
    assert found.is_on("motion_blur") and {camera for camera, _ in found.parameters.blurs} == {"front_left_camera"}
    blurred = apply_plan(alone, found)
    assert blurred.views[0] is first and all(v.blur is not None for v in blurred.views[1:])
    (target,) = view_targets(blurred, [blurred.views[1]])
    assert target.blur == blurred.views[1].blur
    single = plan_effects(setting, replace(chunk(uri), views=(first,)), open_log(uri).cameras)
    assert not single.parameters.blurs and "two images" in single["motion_blur"].reason


def test_novel_views_and_hiding_points_know_no_blur(monkeypatch: pytest.MonkeyPatch) -> None:
    uri = STREET + "&exposure_s=0.05"
    blurred = apply_plan(
        chunk(uri), with_(*DEFAULT_EFFECTS, "motion_blur", parameters=_planned(uri, "motion_blur").parameters)
    )
    assert BlurSamples.from_views(blurred.views_with_role("source")) is not None
    assert BlurSamples.from_views(place_novel_views(blurred, (3.0,))) is None
    calls: list[int] = []
    real = cpu.forward
    monkeypatch.setattr(cpu, "forward", lambda *a, **k: calls.append(len(a[1])) or real(*a, **k))
    plain, planned = load_source_images(chunk(uri)), load_source_images(blurred)
    assert calls[: len(calls) // 2] == calls[len(calls) // 2 :]
    assert all(torch.equal(a.depth, b.depth) for a, b in zip(plain, planned, strict=True))


def test_a_plain_log_makes_the_kernel_calls_of_none(monkeypatch: pytest.MonkeyPatch) -> None:
    uri = STREET + "&moving=0&pedestrians=0"
    calls: list[str] = []
    for name in ("forward", "backward"):
        real = getattr(cpu, name)
        monkeypatch.setattr(cpu, name, lambda *a, _real=real, _name=name, **k: calls.append(_name) or _real(*a, **k))
    counts = []
    for setting in ("auto", "off"):
        found = plan_effects(EffectsConfig(**dict.fromkeys(EFFECT_NAMES, setting)), chunk(uri), open_log(uri).cameras)
        first = initial(InitialConfig(max_points=2000, distant_count=200), chunk(uri), found)
        config = GnetConfig(iterations=3, views_per_iteration=2, method="adam", loss=LossConfig(perceptual=0))
        calls.clear()
        scene = gnet(config, chunk(uri), first, found)
        novel_views(NovelViewsConfig(), chunk(uri), scene, found)
        counts.append(list(calls))
    assert counts[0] == counts[1] and len(counts[0]) > 6


def test_gloss_is_in_images_and_truth_and_without_it_no_bit_changes() -> None:
    plain, none, glossy = (open_log(STREET + q) for q in ("", "&gloss=0", "&gloss=0.5"))
    assert none.image_bytes("front_camera", 3) == plain.image_bytes("front_camera", 3)
    view = chunk().views[0]
    pose = chunk().world_SE3_chunk @ view.chunk_SE3_camera
    images = [log.truth.image(view.frame, pose, view.lens).astype(float) for log in (plain, glossy)]
    assert (images[1] >= images[0]).all() and np.mean(images[1] > images[0] + 5) > 0.2
    assert glossy.image_bytes(view.camera, view.frame) != plain.image_bytes(view.camera, view.frame)


def test_harmonics_are_where_the_plan_has_them() -> None:
    uri = STREET + "&gloss=1"
    first = initial(InitialConfig(max_points=2000, distant_count=200), chunk(uri))
    assert first.scene.spherical_harmonics is None
    config = GnetConfig(iterations=12, views_per_iteration=4, method="adam", loss=LossConfig(perceptual=0, depth=0))
    without = gnet(config, chunk(uri), first, with_(*DEFAULT_EFFECTS))
    within = gnet(config, chunk(uri), first, with_(*DEFAULT_EFFECTS, "view_dependent_colour"))
    assert without.scene.spherical_harmonics is None
    assert within.scene.spherical_harmonics is not None and within.scene.spherical_harmonics.any()
    assert within.losses[0] == without.losses[0] and within.losses[-1] != without.losses[-1]
    config = config.model_copy(update={"method": "street_gs", "per_scene": PerSceneConfig(iterations=2)})
    assert (
        gnet(config, chunk(uri), first, with_(*DEFAULT_EFFECTS, "view_dependent_colour")).scene.spherical_harmonics
        is None
    )


def test_a_per_scene_depth_term_is_there_where_the_plan_has_it() -> None:
    config = GnetConfig(method="street_gs", per_scene=PerSceneConfig(iterations=2, depth=0.5))
    assert drop_unplanned_losses(config, with_("lidar_depth")) == config
    none = drop_unplanned_losses(config, with_("rigid_actors"))
    assert isinstance(none, GnetConfig) and (none.per_scene.depth, none.loss.depth) == (0.0, 0.0)
    first = initial(InitialConfig(max_points=2000, distant_count=200), chunk(STREET))
    told, untold = (gnet(config, chunk(STREET), first, with_(*p)) for p in (("lidar_depth",), ()))
    assert told.losses[0] > untold.losses[0]


def test_a_plan_that_leaves_no_term_of_the_loss_is_refused() -> None:
    depth_alone = LossConfig(rgb=0, perceptual=0, ssim=0, depth=0.1)
    config = GnetConfig(iterations=2, method="adam", loss=depth_alone)
    first = initial(InitialConfig(max_points=2000, distant_count=200), chunk(STREET))
    with pytest.raises(ConfigError, match=r"depth is the only term of loss .*chunk 0.*loss\.rgb or .*lidar_depth=on"):
        gnet(config, chunk(STREET), first, with_("rigid_actors"))
    assert drop_unplanned_losses(config, with_("lidar_depth")) == config
    # The loss of a method that is not used may be empty.
    per_scene = config.model_copy(update={"method": "street_gs"})
    drop_unplanned_losses(per_scene, with_())
    empty = per_scene.model_copy(update={"per_scene": PerSceneConfig(rgb=0, ssim=0, depth=0.1)})
    with pytest.raises(ConfigError, match=r"Give per_scene\.rgb or per_scene\.ssim a weight"):
        drop_unplanned_losses(empty, with_())


def test_targets_carry_what_effects_say() -> None:
    view = replace(chunk().views_with_role("source")[0], log_gain=(0.1, 0.2, 0.3), ego_mask=np.zeros((90, 160), bool))
    (target,) = view_targets(chunk(), [view])
    assert isinstance(target, Target) and target.log_gain == (0.1, 0.2, 0.3) and target.ego_mask is not None
