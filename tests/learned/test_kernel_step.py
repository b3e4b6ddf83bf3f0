"""The compiled step against the torch code, which defines it."""

from __future__ import annotations

import re
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch
from torch import Tensor

from genre_tasks.compiled.loader import supported_instruction_sets
from genre_tasks.config import LossConfig
from genre_tasks.errors import ResourceError
from genre_tasks.learned.features import FEATURE_COUNT, StaticFeatures, compute_features, schedule_features
from genre_tasks.learned.kernel_layers import PairsByOutput
from genre_tasks.learned.kernel_step import KernelStep
from genre_tasks.learned.learned_optimiser import LearnedOptimiser
from genre_tasks.learned.network import NetworkConfig
from genre_tasks.learned.sparse_conv import neighbour_map, pack_keys
from genre_tasks.learned.weights import load_optimiser
from genre_tasks.optimiser.kernels import constants as constants
from genre_tasks.optimiser.kernels import library as library
from genre_tasks.optimiser.kernels.build_network import KERNEL
from genre_tasks.optimiser.objective import Objective
from genre_tasks.optimiser.state import Parameterization, State
from genre_tasks.optimiser.step_rules import StepFunction, StepRule, expand_learning_rates
from genre_tasks.optimiser.tuned_adam import TunedAdam
from genre_tasks.optimiser.unroll import UnrollSettings, unroll
from genre_tasks.scene.gaussians import Gaussians
from genre_tasks.scene.graph import SceneGraph
from genre_tasks.weights import resolve_weights
from tests.optimiser import street_scenes

CENTRE = torch.tensor([0.3, -0.2, 0.1])
TOTAL = 24


def _random(config: NetworkConfig | None = None, seed: int = 0) -> LearnedOptimiser:
    """No weight or bias is zero, and gains and offsets are of order 1."""
    torch.manual_seed(seed)
    network = LearnedOptimiser(config)
    for parameter in network.parameters():
        if not parameter.any():
            torch.nn.init.normal_(parameter, std=0.3)
    return network.eval().requires_grad_(False)


def _torch_step(network: LearnedOptimiser, parameterization: Parameterization) -> StepFunction:
    fixed, pyramid = StaticFeatures.compute(parameterization, CENTRE), network.pyramid(parameterization, CENTRE)

    def step(state: State, gradient: Tensor, total: int) -> Tensor:
        with torch.no_grad():
            return network.delta(
                state, compute_features(parameterization, fixed, state, gradient, total), pyramid, total
            )

    return step


def _kernel_step(network: LearnedOptimiser, parameterization: Parameterization) -> StepFunction:
    step = network.prepare(parameterization, CENTRE)
    assert isinstance(step, KernelStep)
    return step


def _states(
    scene: SceneGraph, unseen: int = 5, size: float = 1.0, with_residuals: bool = False
) -> Iterator[tuple[State, Tensor]]:
    """Five iterations with gradients of many sizes; some Gaussians are never seen, others not always.

    ``with_residuals``: with residuals, of shares from next to nothing to many pixels.
    """
    g, count = torch.Generator().manual_seed(0), len(scene)
    parameterization, state = Parameterization.from_scene(scene), State.zeros(count, scene.gaussians.means)
    for i in range(5):
        gradient = size * torch.randn(count, 14, generator=g) * 10 ** (3 * torch.rand(count, 14, generator=g) - 2)
        gradient[: max(unseen, 40 - 10 * i)] = 0
        gradient[i::5] = 0
        residuals = None
        if with_residuals:
            share = 50 * torch.rand(count, 1, generator=g) ** 3 * (gradient != 0).any(1, keepdim=True)
            residuals = torch.cat([0.3 * share * torch.randn(count, 3, generator=g), 0.2 * share, share], 1)
        state = state.accumulate(gradient, residuals)
        yield state, gradient
        state = state.apply_step(parameterization, 0.1 * torch.randn(count, 14, generator=g))


def _error(network: LearnedOptimiser, scene: SceneGraph, size: float = 1.0) -> float:
    """Largest difference of a step in units of its rate."""
    parameterization = Parameterization.from_scene(scene)
    ours, torchs, rates = (
        _kernel_step(network, parameterization),
        _torch_step(network, parameterization),
        expand_learning_rates(network.config.rates),
    )
    differences = [torch.zeros(1)]
    for state, gradient in _states(scene, size=size, with_residuals=network.uses_image_residuals):
        mine, oracle = ours(state, gradient, TOTAL), torchs(state, gradient, TOTAL)
        assert mine.shape == oracle.shape
        differences.append(((mine - oracle).abs() / rates).flatten())
    return float(torch.cat(differences).max())


def _first(scene: SceneGraph, count: int) -> SceneGraph:
    return SceneGraph(
        Gaussians.unpack(scene.gaussians.pack()[:count].clone()), scene.nodes[:count], scene.actors if count else ()
    )


@contextmanager
def _threads(count: int) -> Iterator[None]:
    before = torch.get_num_threads()
    try:
        torch.set_num_threads(count)
        yield
    finally:
        torch.set_num_threads(before)


@pytest.mark.parametrize("stage", ["gnet", "enet"])
@pytest.mark.parametrize("size", [1e-10, 1.0, 1e8])
def test_the_shipped_networks_step_is_torchs(stage: str, size: float) -> None:
    network = load_optimiser(Path(resolve_weights(stage, "builtin")))
    assert _error(network, street_scenes.scene(400), size) < 1e-4


@pytest.mark.parametrize(
    ("hidden", "channels"),
    [(64, (16, 32, 48)), (4, (1,)), (16, (8, 12)), (33, (17, 3, 40, 5)), (100, (64, 16)), (512, (128,))],
)
def test_any_network_s_step_is_torchs(hidden: int, channels: tuple[int, ...]) -> None:
    assert _error(_random(NetworkConfig(hidden=hidden, channels=channels)), street_scenes.scene()) < 2e-5


@pytest.mark.parametrize("count", [0, 1, 2, 11, 12, 13, 47, 48, 49, 1025])
def test_any_number_of_gaussians(count: int) -> None:
    scene = _first(street_scenes.scene(-(-max(count, 20) // 10) * 10), count)
    assert len(scene) == count
    assert _error(_random(), scene) < 2e-5


@pytest.mark.parametrize("isa", supported_instruction_sets())
def test_every_instruction_set_is_right(isa: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("GENRE_RENDER_ISA", isa)
    monkeypatch.setattr(library, "load_network", library.load_network.__wrapped__)
    scene = street_scenes.scene()
    assert _error(_random(), scene) < 2e-5
    state, gradient = next(_states(scene))
    untrained = LearnedOptimiser().prepare(Parameterization.from_scene(scene), CENTRE)
    assert torch.equal(
        untrained(state, gradient, TOTAL),
        TunedAdam().prepare(Parameterization.from_scene(scene), CENTRE)(state, gradient, TOTAL),
    )


@pytest.mark.parametrize(("iteration", "total"), [(0, 1), (3, 24), (24, 24), (100, 24), (500, 1000)])
def test_schedule_features_are_as_in_torch(iteration: int, total: int) -> None:
    network, scene = _random(), street_scenes.scene()
    state, gradient = next(_states(scene))
    late = replace(state, iteration=iteration)
    steps = [
        make(network, Parameterization.from_scene(scene))(late, gradient, total) for make in (_kernel_step, _torch_step)
    ]
    torch.testing.assert_close(*steps, atol=1e-6, rtol=0)


def test_the_same_bits_at_any_thread_count_and_in_any_run() -> None:
    scene, results = street_scenes.scene(3000), []
    states = list(_states(scene))
    for threads in (1, 2, 3, 2):
        with _threads(threads):
            rules: list[StepRule] = [_random(), TunedAdam()]
            parameterization = Parameterization.from_scene(scene)
            steps = [rule.prepare(parameterization, CENTRE) for rule in rules]
            results.append([step(state, gradient, TOTAL) for step in steps for state, gradient in states])
            results[-1] += [state.accumulate(gradient).first_moment for state, gradient in states]
            results[-1] += [state.apply_step(parameterization, gradient).offsets for state, gradient in states]
    for other in results[1:]:
        assert all(torch.equal(a, b) for a, b in zip(results[0], other, strict=True))


def test_a_step_does_not_depend_on_the_steps_before() -> None:
    scene = street_scenes.scene()
    step, states = _kernel_step(_random(), Parameterization.from_scene(scene)), list(_states(scene))
    forth = [step(state, gradient, TOTAL).clone() for state, gradient in states]
    back = [step(state, gradient, TOTAL) for state, gradient in reversed(states)]
    assert all(torch.equal(a, b) for a, b in zip(forth, reversed(back), strict=True))


def test_adams_step_is_torchs_direction() -> None:
    scene, adam = street_scenes.scene(), TunedAdam()
    for state, gradient in _states(scene):
        expected = -expand_learning_rates(adam.learning_rates.as_tuple()) * state.adam_direction() * state.visible
        step = TunedAdam(schedule="constant").prepare(Parameterization.from_scene(scene), CENTRE)(
            state, gradient, TOTAL
        )
        torch.testing.assert_close(step, expected, atol=0, rtol=1e-6)
        assert not step[:5].any() and bool(step[state.visible[:, 0] > 0].any(1).all())


def _detached(state: State) -> State:
    return replace(
        state,
        **{
            n: getattr(state, n).detach()
            for n in ("offsets", "first_moment", "second_moment", "visit_count", "visible")
        },
    )


@pytest.mark.parametrize("isa", supported_instruction_sets())
def test_the_states_updates_are_torchs(isa: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("GENRE_RENDER_ISA", isa)
    monkeypatch.setattr(library, "load_network", library.load_network.__wrapped__)
    scene = street_scenes.scene(1030)
    parameterization, g = Parameterization.from_scene(scene), torch.Generator().manual_seed(3)
    for state, gradient in _states(scene):
        gradient[100, 1:], gradient[101, :13] = 0, 0  # one attribute is enough to be seen
        for fresh in (State.zeros(len(scene), gradient), state):
            ours, torchs = fresh.accumulate(gradient), _detached(fresh.accumulate(gradient.clone().requires_grad_()))
            for name in ("first_moment", "second_moment"):
                torch.testing.assert_close(getattr(ours, name), getattr(torchs, name), atol=1e-6, rtol=1e-6)
            assert torch.equal(ours.visit_count, torchs.visit_count) and torch.equal(ours.visible, torchs.visible)
            delta = 3 * torch.randn(gradient.shape, generator=g)
            far = replace(ours, offsets=ours.offsets + 2 * torch.randn(delta.shape, generator=g))
            same = (
                far.apply_step(parameterization, delta),
                _detached(far.apply_step(parameterization, delta.clone().requires_grad_())),
            )
            free = ~(parameterization.ground_constraint != 0).any(1)
            assert torch.equal(same[0].offsets[free], same[1].offsets[free])
            torch.testing.assert_close(same[0].offsets, same[1].offsets, atol=1e-5, rtol=1e-5)
            assert same[0].iteration == same[1].iteration and not bool(free.all())
            assert bool((same[0].offsets != far.offsets + delta)[far.visible[:, 0] > 0].any())  # bounds were met
            unseen = far.visible[:, 0] == 0
            assert torch.equal(same[0].offsets[unseen], far.offsets[unseen])
    assert bool((state.visit_count[state.visible == 0] > 0).any())  # some were seen before and not now


def test_what_is_not_a_number_stays_seen_in_the_state() -> None:
    scene = street_scenes.scene()
    parameterization, gradient = Parameterization.from_scene(scene), torch.zeros(len(scene), 14)
    gradient[7, 3] = torch.nan
    state = State.zeros(len(scene), gradient).accumulate(gradient)
    assert bool(torch.isnan(state.first_moment[7, 3])) and state.visit_count[:, 0].nonzero().tolist() == [[7]]
    delta = torch.zeros(len(scene), 14)
    delta[7, :] = torch.nan
    assert bool(torch.isnan(state.apply_step(parameterization, delta).offsets[7]).all())
    with pytest.raises(ValueError, match=r"expected 300 rows of \(14, 14, 14, 1\) columns"):
        state.accumulate(gradient[:, :13])


class _Torch:
    """The rule without the compiled kernel."""

    uses_image_residuals = False

    def __init__(self, network: LearnedOptimiser) -> None:
        self.network = network

    def prepare(self, frame: Parameterization, centre: Tensor) -> StepFunction:
        return _torch_step(self.network, frame)


def test_an_unrolled_optimisation_starts_as_with_torch(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("tests.learned.test_kernel_step.CENTRE", torch.tensor([0.35, 0.0, 0.0]))
    network, truth = _random(), street_scenes.scene()
    rules: list[StepRule] = [network, _Torch(network)]
    losses = [
        unroll(
            r,
            street_scenes.blurred(truth),
            street_scenes.targets(truth),
            (),
            Objective(LossConfig(perceptual=0)),
            UnrollSettings(4, 4),
        ).losses
        for r in rules
    ]
    assert losses[0] == pytest.approx(losses[1], rel=1e-3) and losses[0][3] != losses[0][0]


@pytest.mark.parametrize("where", ["gradient", "offsets", "weights"])
def test_what_is_not_a_number_stays_seen(where: str) -> None:
    scene, network = street_scenes.scene(), _random(NetworkConfig(hidden=16, channels=(8, 12)))
    state, gradient = next(_states(scene))
    if where == "gradient":
        gradient = gradient.clone()
        gradient[61, 3] = torch.nan
    elif where == "offsets":
        state = replace(state, offsets=state.offsets.clone())
        state.offsets[61, 3] = torch.nan
    else:
        network.head.bias[3] = torch.nan
    ours, torchs = (
        make(network, Parameterization.from_scene(scene))(state, gradient, TOTAL)
        for make in (_kernel_step, _torch_step)
    )
    assert bool(torch.isnan(torchs).any()) and torch.equal(torch.isnan(ours), torch.isnan(torchs))


def test_weights_are_those_at_the_start_and_the_state_need_not_be_contiguous() -> None:
    scene, network = street_scenes.scene(), _random()
    state, gradient = next(_states(scene))
    step = _kernel_step(network, Parameterization.from_scene(scene))
    before = step(state, gradient, TOTAL)
    network.head.weight.zero_()
    strided = replace(
        state, first_moment=state.first_moment.T.contiguous().T, second_moment=state.second_moment.T.contiguous().T
    )
    assert torch.equal(step(strided, gradient.T.contiguous().T, TOTAL), before)


def test_the_kernel_is_for_float32_on_the_cpu() -> None:
    scene, network = street_scenes.scene(), _random()
    state, gradient = next(_states(scene))
    assert (
        library.is_supported(gradient)
        and not library.is_supported(gradient.double())
        and not library.is_supported(gradient.to("meta"))
    )
    assert not isinstance(network.double().prepare(Parameterization.from_scene(scene), CENTRE), KernelStep)
    step = _kernel_step(_random(), Parameterization.from_scene(scene))
    with pytest.raises(ValueError, match="float32 tensors on the CPU"):
        step(state, gradient.double(), TOTAL)
    with pytest.raises(ValueError, match=r"expected the gradient of 300 Gaussians, got 299"):
        step(state, gradient[1:], TOTAL)
    with pytest.raises(ValueError, match=r"expected a state and a gradient \[300, 14\]"):
        step(replace(state, first_moment=state.first_moment[1:]), gradient, TOTAL)


def test_pairs_list_a_kernel_map_by_output() -> None:
    coordinates = torch.tensor([[0, 0, 0], [0, 0, 1], [5, 5, 5], [0, 1, 1]])
    kernel_map = neighbour_map(pack_keys(torch.zeros(4, dtype=torch.int64), coordinates).sort().values)
    pairs = PairsByOutput.from_kernel_map(kernel_map)
    listed = {
        (o, *pair) for o in range(4) for pair in pairs.pairs[int(pairs.starts[o]) : int(pairs.starts[o + 1])].tolist()
    }
    offsets = torch.repeat_interleave(torch.arange(27), torch.tensor(kernel_map.starts).diff())
    assert listed == set(zip(kernel_map.outputs.tolist(), kernel_map.inputs.tolist(), offsets.tolist(), strict=True))
    assert PairsByOutput.identity(3).pairs.tolist() == [[0, 0], [1, 0], [2, 0]]


@pytest.mark.parametrize(("status", "match"), [(1, "not enough memory.*fewer Gaussians"), (2, "kernel failed")])
def test_a_failing_kernel_is_an_error(status: int, match: str, monkeypatch: pytest.MonkeyPatch) -> None:
    scene = street_scenes.scene()
    step, (state, gradient) = _kernel_step(_random(), Parameterization.from_scene(scene)), next(_states(scene))
    kernel = SimpleNamespace(genre_network_step=lambda *arguments: status)
    monkeypatch.setattr(library, "load_network", lambda: kernel)
    with pytest.raises(ResourceError, match=match):
        step(state, gradient, TOTAL)


def test_constants_live_in_one_place() -> None:
    text = "".join((KERNEL.folder / name).read_text() for name in KERNEL.sources if not name.endswith(".py"))
    assert {n for n in vars(constants) if n.isupper()} == set(KERNEL.constants)
    assert all(re.search(rf"\b{name}\b", text) for name in KERNEL.constants)
    assert len(schedule_features(0, TOTAL)) + constants.VARYING_FEATURES == FEATURE_COUNT


def test_a_missing_library_says_what_to_run(tmp_path: Path) -> None:
    with pytest.raises(ResourceError, match=r"optimiser's CPU kernel is not compiled.*pip install -e \."):
        library.load_network(tmp_path)
