"""The unrolled loop with both rules, and the hard cases of a learned optimiser."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch

from flows.training.device import move_scene
from genre_tasks.checks import check_finite
from genre_tasks.config import LossConfig
from genre_tasks.errors import InputError, NonFiniteError
from genre_tasks.learned.features import FEATURE_COUNT, StaticFeatures, compute_features
from genre_tasks.learned.learned_optimiser import LearnedOptimiser
from genre_tasks.learned.meta_episodes import TrainingScene
from genre_tasks.learned.network import NetworkConfig
from genre_tasks.optimiser.objective import Objective
from genre_tasks.optimiser.state import Parameterization, State
from genre_tasks.optimiser.step_rules import StepRule
from genre_tasks.optimiser.tuned_adam import GNET_LEARNING_RATES, TunedAdam
from genre_tasks.optimiser.unroll import UnrollSettings, mean_camera_center, unroll
from genre_tasks.scene.gaussians import Gaussians
from genre_tasks.scene.graph import SceneGraph
from genre_tasks.scene.reconstruction import Reconstruction
from tests.optimiser import street_scenes

OBJECTIVE = Objective(LossConfig(perceptual=0))
SMALL = NetworkConfig(hidden=16, channels=(8, 12), rates=GNET_LEARNING_RATES.as_tuple())


def _network(seed: int = 0) -> LearnedOptimiser:
    """With a head that is not zero, as training would leave it."""
    torch.manual_seed(seed)
    network = LearnedOptimiser(SMALL)
    torch.nn.init.normal_(network.head.weight, std=0.02)
    return network.eval().requires_grad_(False)


def _run(rule: StepRule, scene: SceneGraph, truth: SceneGraph, settings: UnrollSettings) -> Reconstruction:
    return unroll(
        rule, scene, street_scenes.targets(truth), street_scenes.targets(truth, novel=True), OBJECTIVE, settings
    )


@pytest.fixture(scope="module")
def truth() -> SceneGraph:
    return street_scenes.scene()


@pytest.mark.parametrize("residuals", [False, True])
def test_an_untrained_network_is_tuned_adam_to_the_bit_unless_residuals_move_colours(
    truth: SceneGraph, residuals: bool
) -> None:
    start, settings = street_scenes.blurred(truth), UnrollSettings(5, 2, 1)
    a = _run(TunedAdam(), start, truth, settings)
    untrained = LearnedOptimiser(SMALL.model_copy(update={"residuals": residuals}))
    b = _run(untrained.eval().requires_grad_(False), start, truth, settings)
    assert (a.losses == b.losses) != residuals
    assert torch.equal(a.scene.gaussians.pack(), b.scene.gaussians.pack()) != residuals


@pytest.mark.parametrize("rule", [TunedAdam(), _network()], ids=["adam", "learned"])
def test_the_loss_falls_and_the_result_says_how(rule: StepRule, truth: SceneGraph) -> None:
    seen = []
    start = street_scenes.blurred(truth)
    result = unroll(
        rule,
        start,
        street_scenes.targets(truth),
        (),
        OBJECTIVE,
        UnrollSettings(20, 4, snapshots=3),
        lambda done, total, note="": seen.append((done, total, note)),
    )
    assert result.losses[-1] < 0.6 * result.losses[0]
    assert len(result.losses) == len(result.seconds_per_iteration) == 20
    assert sorted(result.snapshots) == [5, 10, 15]
    assert seen[-1][:2] == (20, 20) and seen[-1][2].startswith("loss ")
    assert not torch.equal(result.snapshots[5].gaussians.means, result.scene.gaussians.means)
    assert not result.scene.gaussians.means.requires_grad


def test_same_seed_same_bytes_at_any_thread_count(truth: SceneGraph) -> None:
    start, before, results = street_scenes.blurred(truth), torch.get_num_threads(), []
    try:
        for threads in (1, 2):
            torch.set_num_threads(threads)
            results.append(_run(_network(), start, truth, UnrollSettings(4, 2, 2, seed=7)))
    finally:
        torch.set_num_threads(before)
    assert results[0].losses == results[1].losses
    assert torch.equal(results[0].scene.gaussians.pack(), results[1].scene.gaussians.pack())
    other = _run(_network(), start, truth, UnrollSettings(4, 2, 2, seed=8))
    assert other.losses != results[0].losses


def _hidden(scene: SceneGraph) -> SceneGraph:
    """The first five Gaussians behind every camera."""
    means = scene.gaussians.means.clone()
    means[:5] = torch.tensor([0.0, 0.0, -50.0])
    return scene.with_gaussians(replace(scene.gaussians, means=means))


@pytest.mark.parametrize("rule", [TunedAdam(), _network()], ids=["adam", "learned"])
def test_a_gaussian_that_no_view_has_seen_gets_exactly_no_update(rule: StepRule, truth: SceneGraph) -> None:
    start = _hidden(street_scenes.blurred(truth))
    result = _run(rule, start, truth, UnrollSettings(6, 4, 4))
    before, after = start.gaussians.pack(), result.scene.gaussians.pack()
    assert torch.equal(before[:5], after[:5])
    assert bool((before[5:] != after[5:]).any())


@pytest.mark.parametrize("rule", [TunedAdam(), _network()], ids=["adam", "learned"])
def test_what_this_iterations_views_do_not_see_stays_where_it_is(rule: StepRule, truth: SceneGraph) -> None:
    parameterization, generator = Parameterization.from_scene(truth), torch.Generator().manual_seed(0)
    state, step = (
        State.zeros(len(truth), truth.gaussians.means),
        rule.prepare(Parameterization.from_scene(truth), torch.zeros(3)),
    )
    for seen in (slice(None), slice(0, None, 2)):
        gradient = torch.zeros(len(truth), 14)
        gradient[seen] = torch.randn(gradient[seen].shape, generator=generator)
        before, state = state.offsets, state.accumulate(gradient)
        state = state.apply_step(parameterization, step(state, gradient, 8))
    assert torch.equal(state.offsets[1::2], before[1::2])
    assert bool((state.offsets[::2] != before[::2]).any(1).all())


def _step(network: LearnedOptimiser, scene: SceneGraph, gradient: torch.Tensor, shift: float = 0.0) -> torch.Tensor:
    parameterization = Parameterization.from_scene(scene)
    centre = torch.tensor([shift, 0.0, 0.0])
    state = State.zeros(len(scene), gradient).accumulate(gradient)
    return network.prepare(parameterization, centre)(state, gradient, 24)


def test_permuting_the_gaussians_permutes_the_step(truth: SceneGraph) -> None:
    gradient = torch.randn(len(truth), 14, generator=torch.Generator().manual_seed(0))
    order = torch.randperm(len(truth), generator=torch.Generator().manual_seed(1))
    mixed = replace(truth, gaussians=Gaussians.unpack(truth.gaussians.pack()[order].clone()), nodes=truth.nodes[order])
    network = _network()
    torch.testing.assert_close(
        _step(network, mixed, gradient[order]), _step(network, truth, gradient)[order], atol=1e-5, rtol=0
    )


def test_shifting_everything_by_whole_voxels_changes_nothing() -> None:
    scene = street_scenes.scene(actor=False)
    gradient = torch.randn(len(scene), 14, generator=torch.Generator().manual_seed(0))
    coarsest = SMALL.voxel_m * 2**5 * 2 * 2 ** (len(SMALL.channels) - 1)
    g = scene.gaussians
    moved = scene.with_gaussians(replace(g, means=g.means + torch.tensor([coarsest, 0.0, 0.0])))
    network = _network()
    torch.testing.assert_close(
        _step(network, moved, gradient, shift=coarsest), _step(network, scene, gradient), atol=1e-5, rtol=0
    )


@pytest.mark.parametrize("size", [1e-12, 1e-6, 1.0, 1e8])
def test_the_step_does_not_depend_on_the_size_of_the_loss(size: float, truth: SceneGraph) -> None:
    gradient = torch.randn(len(truth), 14, generator=torch.Generator().manual_seed(0))
    torch.testing.assert_close(
        _step(_network(), truth, size * gradient), _step(_network(), truth, gradient), atol=1e-4, rtol=0
    )


def test_gradients_of_many_sizes_at_once_give_finite_bounded_features(truth: SceneGraph) -> None:
    generator = torch.Generator().manual_seed(0)
    sizes = 10 ** (torch.rand(len(truth), 14, generator=generator) * 20 - 12)
    gradient = torch.randn(len(truth), 14, generator=generator) * sizes
    parameterization = Parameterization.from_scene(truth)
    fixed = StaticFeatures.compute(parameterization, torch.zeros(3))
    inputs = compute_features(
        parameterization, fixed, State.zeros(len(truth), gradient).accumulate(gradient), gradient, 24
    )
    assert inputs.shape == (len(truth), FEATURE_COUNT)
    assert bool(torch.isfinite(inputs).all()) and float(inputs.abs().max()) < 20
    assert bool(torch.isfinite(_step(_network(), truth, gradient)).all())


def test_far_beyond_its_horizon_it_stays_bounded(truth: SceneGraph) -> None:
    result = unroll(
        TunedAdam(), street_scenes.blurred(truth), street_scenes.targets(truth), (), OBJECTIVE, UnrollSettings(12, 4)
    )
    long = unroll(
        TunedAdam(), street_scenes.blurred(truth), street_scenes.targets(truth), (), OBJECTIVE, UnrollSettings(120, 4)
    )
    assert long.losses[-1] <= result.losses[-1] * 1.05
    packed = long.scene.gaussians.pack()
    assert bool(torch.isfinite(packed).all())


@pytest.mark.parametrize("count", [0, 1])
def test_empty_and_single_scenes(count: int) -> None:
    full = street_scenes.scene(actor=False)
    scene = SceneGraph(
        Gaussians.unpack(full.gaussians.pack()[50 : 50 + count].clone()), full.nodes[50 : 50 + count], ()
    )
    result = unroll(_network(), scene, street_scenes.targets(full), (), OBJECTIVE, UnrollSettings(2, 2))
    assert len(result.scene) == count
    assert bool(torch.isfinite(result.scene.gaussians.pack()).all())


def test_all_gaussians_in_one_voxel() -> None:
    full = street_scenes.scene(actor=False)
    g = full.gaussians
    scene = full.with_gaussians(replace(g, means=torch.tensor([0.0, 0.0, 6.0]).expand(len(full), 3).clone()))
    result = unroll(_network(), scene, street_scenes.targets(full), (), OBJECTIVE, UnrollSettings(2, 2))
    assert bool(torch.isfinite(result.scene.gaussians.pack()).all())


@pytest.mark.parametrize("rule", [_network(), TunedAdam()])
def test_a_scene_out_of_every_view_is_an_error_that_says_so(rule: StepRule) -> None:
    full = street_scenes.scene(actor=False)
    behind = full.with_gaussians(replace(full.gaussians, means=full.gaussians.means - torch.tensor([0.0, 0.0, 1e3])))
    with pytest.raises(
        InputError, match=rf"None of the scene's {len(full)} Gaussians .* source views .*frames \d"
    ) as hit:
        unroll(rule, behind, street_scenes.targets(full), (), OBJECTIVE, UnrollSettings(9, 2, stage="gnet"))
    assert "genre check" in str(hit.value.remedy)


def test_cameras_and_rates_are_where_the_scene_is(truth: SceneGraph) -> None:
    elsewhere = torch.device("meta")  # any device but the CPU
    targets = move_scene(TrainingScene("s", truth, street_scenes.targets(truth), ()), elsewhere).source
    assert mean_camera_center(targets).device == elsewhere
    state = State.zeros(4, torch.empty(0, device=elsewhere))
    assert (
        TunedAdam().prepare(Parameterization.from_scene(truth), torch.zeros(3))(state, state.first_moment, 4).device
        == elsewhere
    )


def test_a_step_that_is_not_finite_is_named(truth: SceneGraph) -> None:
    class Broken:
        uses_image_residuals = False

        def prepare(self, parameterization: Parameterization, centre: torch.Tensor):
            def step(state: State, gradient: torch.Tensor, total: int) -> torch.Tensor:
                delta = torch.zeros_like(gradient)
                delta[-1, 4] = torch.nan
                return delta

            return step

    with pytest.raises(NonFiniteError) as raised:
        unroll(
            Broken(),
            street_scenes.blurred(truth),
            street_scenes.targets(truth),
            (),
            OBJECTIVE,
            UnrollSettings(2, 2, stage="gnet"),
        )
    assert raised.value.stage == "gnet" and raised.value.first_index == (len(truth) - 1, 4)


def test_a_sum_that_overflows_is_no_fault_and_infinities_do_not_cancel() -> None:
    values = torch.full((3, 14), 3e38)
    assert not torch.isfinite(values.sum())
    check_finite(values, "gradient", "gnet")
    values[1, 2], values[2, 5] = torch.inf, -torch.inf
    with pytest.raises(NonFiniteError) as raised:
        check_finite(values, "gradient", "gnet")
    assert raised.value.first_index == (1, 2)


def test_bounds_hold_and_what_starts_outside_may_stay() -> None:
    scene = street_scenes.scene(actor=False)
    parameterization = Parameterization.from_scene(scene)
    state = State.zeros(len(scene), scene.gaussians.means).accumulate(torch.ones(len(scene), 14))
    far = state.apply_step(parameterization, torch.full((len(scene), 14), 100.0))
    g = parameterization.gaussians_at(far.offsets)
    assert float(g.logit_opacities.max()) <= 9.0 + 1e-5
    assert float(g.log_scales[30:].max()) <= 1.0987 and float(g.log_scales[:30].max()) <= 4.6001
    assert float(g.colors.max()) <= 1.5 + 1e-5


def test_no_side_grows_beyond_eight_times_the_longest_one_at_the_start() -> None:
    scene = street_scenes.scene(actor=False)
    start = scene.gaussians.log_scales
    parameterization, gradient = Parameterization.from_scene(scene), torch.ones(len(scene), 14)
    far = (
        State.zeros(len(scene), scene.gaussians.means).accumulate(gradient).apply_step(parameterization, 100 * gradient)
    )
    grown = parameterization.gaussians_at(far.offsets).log_scales
    longest = start.max(1, keepdim=True).values
    assert bool((grown <= longest + math.log(8) + 1e-5).all())
    assert bool((grown > longest + math.log(8) - 1e-3).any())  # the bound was met
    held = far.apply_step(parameterization, torch.zeros(len(scene), 14))
    assert torch.equal(held.offsets, far.offsets)
