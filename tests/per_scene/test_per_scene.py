"""Per-scene 3DGS on a tiny street: it learns, grows, stops, goes on and repeats itself."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from genre_tasks.config import DensityConfig, PerSceneConfig
from genre_tasks.errors import NonFiniteError
from genre_tasks.losses.rendering_loss import depth_loss
from genre_tasks.losses.ssim import SsimTarget
from genre_tasks.losses.targets import Target
from genre_tasks.per_scene.run import reconstruct_per_scene, train_with_snapshots
from genre_tasks.per_scene.setup import freeze_actors, measure_node_extents, scale_density_schedule
from genre_tasks.per_scene.training import SH_C0, PerSceneTraining
from genre_tasks.render import render_views
from genre_tasks.scene.gaussians import Gaussians
from genre_tasks.scene.graph import DISTANT, FIRST_ACTOR, STATIC, SceneGraph
from tests.optimiser import street_scenes

ALIVE = PerSceneConfig(
    iterations=300, density=DensityConfig(every=1000, reset_every=9000, max_gaussians=400, prune_scale=10.0)
)
"""Grows and prunes in every tenth iteration from the sixth to the 149th, resets in the 90th."""


def _training(config: PerSceneConfig = ALIVE, seed: int = 0) -> PerSceneTraining:
    truth = street_scenes.scene()
    return PerSceneTraining(config, street_scenes.blurred(truth), street_scenes.targets(truth), seed)


def _packed(training: PerSceneTraining) -> torch.Tensor:
    return training.scene.gaussians.pack()


def test_it_recovers_grows_within_its_bound_and_keeps_the_distant() -> None:
    training = _training()
    start = training.scene
    result = reconstruct_per_scene(training, frozenset({60, 200}))
    assert np.mean(result.losses[-20:]) < 0.5 * np.mean(result.losses[:4])
    assert sorted(result.snapshots) == [60, 200]
    counts = [len(result.snapshots[60]), len(result.scene)]
    assert len(start) < counts[0] <= 400 and counts[1] <= 400
    for scene in (*result.snapshots.values(), result.scene):
        assert scene.nodes.shape == (len(scene.gaussians),)
        assert int((scene.nodes == DISTANT).sum()) == int((start.nodes == DISTANT).sum())
        assert set(scene.nodes.tolist()) == {STATIC, DISTANT, FIRST_ACTOR}
    assert len(result.seconds_per_iteration) == 300
    assert not result.scene.gaussians.means.requires_grad
    assert torch.equal(start.gaussians.pack(), street_scenes.blurred(street_scenes.scene()).gaussians.pack())


def test_it_grows_where_the_picture_disagrees_alone() -> None:
    """A perfect start, but for one Gaussian whose truth has moved."""
    truth = street_scenes.scene(actor=False)
    views = street_scenes.targets(truth)
    g = truth.gaussians
    seen = torch.nonzero((g.means[:, 2] < 6) & (truth.nodes == STATIC) & (g.means[:, :2].abs().amax(1) < 1))[0]
    means = g.means.clone()
    means[seen] += torch.tensor([0.3, 0.0, 0.0])
    quick = DensityConfig(start=0, every=10, stop=15_000)
    config = PerSceneConfig(iterations=30_000, means_lr=0.0, density=quick)
    training = PerSceneTraining(config, truth.with_gaussians(replace(g, means=means)), views)
    for _ in range(9):
        training.step()
    screen_gradient = training.state()[0]["screen_gradient"]
    assert int(screen_gradient.argmax()) == int(seen)
    training.step()
    grown = training.scene
    assert len(grown) > len(truth)
    child = grown.gaussians.means[len(truth) :]
    assert bool(((child - means[seen]).norm(dim=1) < 1.0).any())


def test_same_seed_same_bytes_at_any_thread_count() -> None:
    before, results = torch.get_num_threads(), []
    try:
        for threads in (1, 2):
            torch.set_num_threads(threads)
            training = _training()
            losses = [training.step() for _ in range(100)]
            results.append((losses, _packed(training), training.scene.nodes))
    finally:
        torch.set_num_threads(before)
    assert results[0][0] == results[1][0]
    assert torch.equal(results[0][1], results[1][1]) and torch.equal(results[0][2], results[1][2])
    other = _training(seed=1)
    assert [other.step() for _ in range(100)] != results[0][0]


@pytest.mark.parametrize("at", [3, 57, 90])
def test_interrupted_and_taken_up_again_it_ends_in_the_same_bytes(at: int) -> None:
    whole, first, second = _training(), _training(), _training(seed=9)
    for _ in range(130):
        whole.step()
    for _ in range(at):
        first.step()
    second.restore(*first.state())
    assert second.iteration == at and second.seconds == first.seconds
    first.step()  # what was saved does not change with what it was saved from
    for _ in range(130 - at):
        second.step()
    assert torch.equal(_packed(whole), _packed(second)) and torch.equal(whole.scene.nodes, second.scene.nodes)


def test_looking_changes_nothing_and_costs_no_time() -> None:
    looked, silent = _training(), _training()
    seen = []
    for snapshot in train_with_snapshots(
        looked, iterations=(10, 20), seconds=(0.0, looked.seconds + 1e-9, 1e9), budget_s=1e9
    ):
        seen.append(snapshot)
        snapshot.scene.gaussians.means.zero_()
        if snapshot.iteration == 20:
            break
    for _ in range(20):
        silent.step()
    assert [s.iteration for s in seen] == [1, 10, 20]
    assert seen[0].seconds < seen[1].seconds < seen[2].seconds == looked.seconds
    assert torch.equal(_packed(looked), _packed(silent))
    *_, last = train_with_snapshots(looked, budget_s=looked.seconds + 1e-9)
    assert last.iteration == 21
    assert [s.iteration for s in train_with_snapshots(looked)] == [300]


def test_the_first_step_moves_each_attribute_by_its_rate() -> None:
    config = PerSceneConfig()
    training = _training(config)
    before = _packed(training)
    training.step()
    nodes, moved = training.scene.nodes, (_packed(training) - before).abs()
    extent = measure_node_extents(training.scene, training.source)
    for node, metres in enumerate(extent.tolist()):
        largest = moved[nodes == node].amax(0)
        assert float(largest[:3].max()) == pytest.approx(1.6e-4 * metres, rel=2e-2)
        assert float(largest[3:6].max()) == pytest.approx(5e-3, rel=1e-3)
        assert float(largest[11:].max()) == pytest.approx(SH_C0 * 2.5e-3, rel=1e-3)
    assert float(moved[:, 6:10].max()) == pytest.approx(1e-3, rel=1e-3)
    assert float(moved[:, 10].max()) == pytest.approx(5e-2, rel=1e-3)


def test_extents_are_of_the_cameras_and_of_the_actors_box() -> None:
    scene = street_scenes.scene()
    box = replace(scene.actors[0], size_m=(4.0, 2.0, 1.5))
    views = street_scenes.targets(scene)  # at x = 0, 0.5, 0.2, 0.7
    extents = measure_node_extents(replace(scene, actors=(box,)), views)
    assert extents.tolist() == [1.0, 1.0, 3.0]
    far = [replace(t, chunk_SE3_camera=street_scenes.pose(20.0 * k)) for k, t in enumerate(views)]
    assert float(measure_node_extents(scene, far)[STATIC]) == pytest.approx(1.1 * 30)


def test_the_timetable_scales_with_the_length_but_sees_all_views_between_growths() -> None:
    assert scale_density_schedule(PerSceneConfig(), 15) == DensityConfig()
    short = scale_density_schedule(PerSceneConfig(iterations=3000), 4)
    assert (short.start, short.stop, short.every, short.reset_every) == (50, 1500, 10, 300)
    assert scale_density_schedule(PerSceneConfig(iterations=3000), 15).every == 15


def test_without_motion_an_actor_stands_where_it_is_in_the_middle_of_its_path() -> None:
    scene = street_scenes.scene()
    still = freeze_actors(scene)
    moving = scene.nodes == FIRST_ACTOR
    assert not still.actors and still.nodes[moving].unique().tolist() == [STATIC]
    assert torch.equal(still.nodes == DISTANT, scene.nodes == DISTANT)
    middle = scene.gaussians.means[moving] + torch.tensor([1.0, 0.0, 6.0])
    assert torch.allclose(still.gaussians.means[moving], middle)
    assert torch.equal(still.gaussians.pack()[~moving], scene.gaussians.pack()[~moving])


def test_a_loss_that_is_not_finite_is_named() -> None:
    truth = street_scenes.scene()
    views = [
        replace(t, image=SsimTarget.from_image(torch.full((32, 48, 3), torch.nan)))
        for t in street_scenes.targets(truth)
    ]
    with pytest.raises(NonFiniteError, match="loss") as raised:
        PerSceneTraining(ALIVE, truth, views, stage="gnet").step()
    assert raised.value.stage == "gnet"


def test_an_empty_scene_stays_empty() -> None:
    full = street_scenes.scene(actor=False)
    nobody = SceneGraph(Gaussians.unpack(full.gaussians.pack()[:0]), full.nodes[:0], ())
    result = reconstruct_per_scene(
        PerSceneTraining(ALIVE.model_copy(update={"iterations": 12}), nobody, street_scenes.targets(full))
    )
    assert len(result.scene) == 0 and len(result.losses) == 12


def test_without_its_depth_term_lidar_changes_no_bit_and_with_it_depths_come_nearer() -> None:
    truth = street_scenes.scene()
    views = street_scenes.targets(truth)
    bare = tuple(replace(v, depth=None) for v in views)
    start = street_scenes.blurred(truth)
    quiet = ALIVE.model_copy(update={"iterations": 60})

    def trained(depth: float, targets: tuple[Target, ...]) -> SceneGraph:
        return reconstruct_per_scene(PerSceneTraining(quiet.model_copy(update={"depth": depth}), start, targets)).scene

    plain = trained(0.0, views)
    assert torch.equal(plain.gaussians.pack(), trained(0.0, bare).gaussians.pack())
    assert torch.equal(plain.gaussians.pack(), trained(1.0, bare).gaussians.pack())

    def error(scene: SceneGraph) -> float:
        depth = render_views(scene, views).expected_depth()
        return sum(float(depth_loss(d, v.depth)) for d, v in zip(depth, views, strict=True) if v.depth is not None)

    assert error(trained(1.0, views)) < 0.8 * error(plain)
