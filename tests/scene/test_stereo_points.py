"""Multi-view stereo: depths against the street's own, and points only where they belong."""

from __future__ import annotations

import io
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from PIL import Image

from genre_tasks.config import EffectsConfig, IngestConfig
from genre_tasks.effects import multi_view_stereo
from genre_tasks.effects.apply_plan import apply_plan
from genre_tasks.effects.plan import EFFECT_NAMES, plan_effects
from genre_tasks.effects.types import EffectParameters
from genre_tasks.logs.registry import open_log
from genre_tasks.logs.synthetic.log import SyntheticStreet
from genre_tasks.scene.box_projection import project_box
from genre_tasks.scene.chunk import NO_SWEEP, Chunk, Points, View
from genre_tasks.scene.plane_sweep import FARTHEST_M, NEAREST_M, SweepImage, compute_depth_map
from genre_tasks.scene.stereo_points import (
    NEIGHBOURS,
    SWEEP_PIXELS,
    choose_sweep_width,
    find_neighbours,
    find_stereo_points,
    find_unscanned_pixels,
)
from genre_tasks.stages.ingest import ingest

STREET = "synthetic:street?seed=903&cameras=3&width=160&height=90&samples=4&frames=8"
ONLY_STEREO = EffectsConfig(**{name: "auto" if name == "multi_view_stereo" else "off" for name in EFFECT_NAMES})


@cache
def chunk(uri: str = STREET) -> Chunk:
    return ingest(IngestConfig(width_px=160, height_px=90, source_every=2), open_log(uri), 0)


@cache
def stereo_points() -> Points:
    return find_stereo_points(chunk(), chunk().views_with_role("source"))


def _true_depth(frame: int, pose: np.ndarray, image: SweepImage) -> np.ndarray:
    log = open_log(STREET)
    assert isinstance(log, SyntheticStreet)
    return log.depth(frame, chunk().world_SE3_chunk @ pose, image.lens)


def test_the_depth_of_a_textured_street_is_that_of_its_ray_cast() -> None:
    views = chunk().views_with_role("source")
    view = next(v for v in views if v.camera == "front_left_camera")
    image = SweepImage.from_view(view, 160)
    others = [SweepImage.from_view(views[k], 160) for k in find_neighbours(view, views)]
    depth = compute_depth_map(image, others)
    true = _true_depth(view.frame, view.chunk_SE3_camera, image)
    judged = (true > NEAREST_M) & (true < 40) & (image.contrast.numpy() > 0.03)
    assert judged.sum() > 1000
    assert np.median(np.abs(depth / true - 1)[judged]) < 0.05
    assert depth.dtype == np.float32 and depth.min() >= NEAREST_M - 1e-3 and depth.max() <= FARTHEST_M + 1e-2


def _halve_exposure(view: View) -> View:
    """Half as bright and with half of the contrast: what a shorter exposure does."""
    pixels = np.asarray(Image.open(io.BytesIO(view.image)).convert("RGB"))
    encoded = io.BytesIO()
    Image.fromarray(pixels // 2).save(encoded, "PNG")
    return replace(view, image=encoded.getvalue())


def test_exposure_does_not_change_the_depth() -> None:
    views = chunk().views_with_role("source")
    others = [views[k] for k in find_neighbours(views[0], views)]
    image = SweepImage.from_view(views[0], 160)
    one = compute_depth_map(image, [SweepImage.from_view(view, 160) for view in others])
    other = compute_depth_map(image, [SweepImage.from_view(_halve_exposure(view), 160) for view in others])
    # Where an image has no contrast, rounding decides.
    judged = image.contrast.numpy() > 0.03
    assert judged.sum() > 1000
    assert np.median(np.abs(other / one - 1)[judged]) < 0.01


def test_stereo_points_lie_on_surfaces() -> None:
    points = stereo_points()
    assert len(points) > 500
    assert points.colored.all() and (points.frames == NO_SWEEP).all()
    # Seen by the view nearest to it, a point is as far away as what is there, in three of four cases.
    views = chunk().views_with_role("source")
    errors = []
    for view in views:
        image = SweepImage.from_view(view, choose_sweep_width(view))
        camera = np.linalg.inv(view.chunk_SE3_camera)
        local = points.positions @ camera[:3, :3].T + camera[:3, 3]
        lens = image.lens
        ahead = local[local[:, 2] > 1.0]
        column = np.floor(ahead[:, 0] / ahead[:, 2] * lens.fx_px + lens.cx_px).astype(int)
        row = np.floor(ahead[:, 1] / ahead[:, 2] * lens.fy_px + lens.cy_px).astype(int)
        inside = (column >= 0) & (column < lens.width_px) & (row >= 0) & (row < lens.height_px)
        true = _true_depth(view.frame, view.chunk_SE3_camera, image)[row[inside], column[inside]]
        errors.append(np.abs(ahead[inside, 2] / true - 1))
    assert np.median(np.concatenate(errors)) < 0.1


def test_no_point_is_where_lidar_has_some_or_an_actor_is() -> None:
    for view in chunk().views_with_role("source")[::3]:
        mask = find_unscanned_pixels(chunk(), view, 160)
        for actor in chunk().actors:
            (left, top), (right, bottom) = project_box(actor, view)
            if right > left and bottom > top:
                assert not mask[top : bottom + 1, left : right + 1].any()
    # Everything is scanned where each pixel has a point of its own.
    view = chunk().views_with_role("source")[0]
    image = SweepImage.from_view(view, 160)
    rays = np.stack(np.meshgrid(np.arange(160) + 0.5, np.arange(90) + 0.5), -1).reshape(-1, 2)
    lens = image.lens
    local = np.column_stack(
        [(rays[:, 0] - lens.cx_px) / lens.fx_px, (rays[:, 1] - lens.cy_px) / lens.fy_px, np.ones(len(rays))]
    )
    wall = (10 * local @ view.chunk_SE3_camera[:3, :3].T + view.chunk_SE3_camera[:3, 3]).astype(np.float32)
    count = len(wall)
    walled = Points(wall, np.zeros((count, 3), np.uint8), np.ones(count, bool), np.zeros(count, np.int16))
    assert not find_unscanned_pixels(replace(chunk(), static=walled), view, 160).any()


def test_neighbours_see_the_same_from_another_place() -> None:
    views = chunk().views_with_role("source")
    found = find_neighbours(views[0], views)
    assert 0 < len(found) <= NEIGHBOURS and 0 not in found
    assert all(views[k].camera == views[0].camera for k in found[:1])
    # A vehicle that stands has no parallax, and so no points.
    still = chunk(STREET + "&standstill=1")
    sources = still.views_with_role("source")
    assert not any(find_neighbours(view, sources) for view in sources)
    assert len(find_stereo_points(still, sources)) == 0


def test_images_are_compared_at_one_size() -> None:
    view = chunk().views_with_role("source")[0]
    assert choose_sweep_width(view) == 160
    large = replace(view, lens=view.lens.resized_to_width(1920))
    lens = large.lens.resized_to_width(choose_sweep_width(large))
    assert lens.width_px * lens.height_px == pytest.approx(SWEEP_PIXELS, rel=0.02)


def test_the_gate_flips_at_its_threshold(monkeypatch: pytest.MonkeyPatch) -> None:
    cameras = open_log(STREET).cameras
    # The points do not depend on the threshold, so they are found once.
    effect = replace(multi_view_stereo.EFFECT, fit=lambda _: EffectParameters(stereo_points=stereo_points()))
    monkeypatch.setattr(multi_view_stereo, "EFFECT", effect)
    value = plan_effects(ONLY_STEREO, chunk(), cameras)["multi_view_stereo"].value
    for factor, choice in ((0.98, "on"), (1.02, "off")):
        moved = replace(effect, threshold=factor * value)
        monkeypatch.setattr(multi_view_stereo, "EFFECT", moved)
        plan = plan_effects(ONLY_STEREO, chunk(), cameras)
        assert plan["multi_view_stereo"].choice == choice
        assert (plan.parameters.stereo_points is not None) == (choice == "on")


def test_the_points_join_the_background() -> None:
    settings = ONLY_STEREO.model_copy(update={"multi_view_stereo": "on", "rigid_actors": "on"})
    plan = plan_effects(settings, chunk(), open_log(STREET).cameras)
    joined = apply_plan(chunk(), plan).static
    assert len(joined) == len(chunk().static) + len(stereo_points())
    assert np.array_equal(joined.positions[-len(stereo_points()) :], stereo_points().positions)


def test_without_parallax_the_effect_is_off_and_says_why() -> None:
    still = chunk(STREET + "&standstill=1")
    decision = plan_effects(ONLY_STEREO, still, open_log(STREET).cameras)["multi_view_stereo"]
    assert decision.choice == "off" and "from different places" in decision.reason


def test_the_stated_cost_holds_for_any_number_of_images() -> None:
    assert "second" not in multi_view_stereo.EFFECT.cost and "all the others" in multi_view_stereo.EFFECT.cost
