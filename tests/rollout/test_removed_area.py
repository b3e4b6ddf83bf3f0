"""What removed actors hid: by the images in which they stood elsewhere."""

from __future__ import annotations

from dataclasses import replace

import torch

from genre_tasks.fixer.source_images import load_source_images
from genre_tasks.render import RenderSettings
from genre_tasks.rollout.background_repair import repair_background
from genre_tasks.rollout.removed_area import (
    RemovedActors,
    find_uncovered_area,
    select_actors,
    separate_removed_actors,
)
from genre_tasks.scene.constants import ABSENT_LOGIT
from genre_tasks.scene.graph import FIRST_ACTOR, STATIC
from tests.rollout.small_rollout import covered_by_car, images_at, recorded, without_car

SETTINGS = RenderSettings()


def separate() -> RemovedActors:
    base = recorded().chunk_scene
    views = base.chunk.views_with_role("source")
    return separate_removed_actors(base.scene, base.scene.actors, load_source_images(base.chunk), views, SETTINGS)


def test_the_gaussians_of_the_chosen_actors_alone_are_taken():
    scene = recorded().chunk_scene.scene
    car = select_actors(scene, {"mover"})
    assert len(car) == int((scene.nodes == FIRST_ACTOR).sum()) > 0
    assert len(select_actors(scene, set())) == 0


def test_recorded_images_show_nothing_behind_a_removed_actor():
    removed = separate()
    plain = load_source_images(recorded().chunk_scene.chunk)
    car_distance_m = 7.0 - 0.3 - 2.0
    for before, after in zip(plain, removed.sources, strict=True):
        known = before.depth > 0
        assert bool((after.depth[known] <= before.depth[known] + 1e-5).all())
        changed = after.depth != before.depth
        assert 0 < changed.sum() < 0.3 * changed.numel()
        assert after.depth[changed].min() > car_distance_m - 0.5


def test_the_area_is_what_no_image_shows():
    images = images_at(without_car(), 2.0)[0]
    removed = separate()
    area = find_uncovered_area(images, images.depth, removed, SETTINGS)
    covered = covered_by_car(2.0)
    assert area.any()
    assert (area & ~covered).sum() <= 0.1 * area.sum()
    # Were nothing to hide the ground, images would show it.
    clear = tuple(replace(s, depth=torch.zeros_like(s.depth)) for s in removed.sources)
    open_view = replace(removed, sources=clear)
    assert find_uncovered_area(images, images.depth, open_view, SETTINGS).sum() < area.sum()


def test_what_is_nearer_than_the_actor_is_not_filled():
    images = images_at(without_car(), 2.0)[0]
    near = torch.full_like(images.depth, 1.0)
    assert not find_uncovered_area(images, near, separate(), SETTINGS).any()


def test_the_road_under_a_removed_actor_takes_the_colours_of_the_road():
    base = recorded().chunk_scene
    edited = without_car().chunk_scene
    removed = separate()
    before = edited.scene.gaussians
    repaired = repair_background(edited.scene, base.chunk, base.scene.actors, removed).gaussians
    assert torch.equal(repaired.means, before.means)
    changed = (repaired.colors != before.colors).any(1)
    assert changed.any() and bool((edited.scene.nodes[changed] == STATIC).all())
    # The middle of colours that were there: never brighter or darker than all of them.
    static = before.colors[edited.scene.nodes == STATIC]
    assert bool(
        (repaired.colors[changed] >= static.amin(0)).all() and (repaired.colors[changed] <= static.amax(0)).all()
    )
    assert bool((repaired.logit_opacities[changed] >= before.logit_opacities[changed]).all())


def test_nothing_stays_where_an_actor_drove_through():
    base = recorded().chunk_scene
    scene = without_car().chunk_scene.scene
    ghost = scene.gaussians.means.clone()
    ghost[0] = torch.from_numpy(base.scene.actors[0].chunk_SE3_box[0, :3, 3])
    nodes = scene.nodes.clone()
    nodes[0] = STATIC
    haunted = replace(scene, gaussians=replace(scene.gaussians, means=ghost), nodes=nodes)
    repaired = repair_background(haunted, base.chunk, base.scene.actors, separate())
    assert repaired.gaussians.logit_opacities[0] == ABSENT_LOGIT
    assert (repaired.gaussians.logit_opacities == ABSENT_LOGIT).sum() < 0.05 * len(scene)
