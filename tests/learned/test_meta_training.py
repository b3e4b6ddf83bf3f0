"""Meta-training learns, and resumes to the same bytes."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from safetensors import safe_open
from safetensors.torch import save_file

from flows.training import checkpoint
from flows.training.curve_table import LEARNING_CURVE, load_rows
from flows.training.optimiser_training import initialise_network, train_optimiser
from genre_tasks.config import LearningRates, LossConfig
from genre_tasks.errors import InputError
from genre_tasks.learned.features import compute_features
from genre_tasks.learned.learned_optimiser import LearnedOptimiser
from genre_tasks.learned.meta_episodes import Episode, EpisodeConfig, TrainingScene
from genre_tasks.learned.meta_training import MetaConfig, MetaTraining
from genre_tasks.learned.network import NetworkConfig
from genre_tasks.optimiser.objective import Objective
from genre_tasks.optimiser.tuned_adam import GNET_LEARNING_RATES, TunedAdam
from genre_tasks.optimiser.unroll import UnrollSettings, unroll
from tests.optimiser import street_scenes

RATES = tuple(0.3 * r for r in GNET_LEARNING_RATES.as_tuple())
NETWORK = NetworkConfig(hidden=16, channels=(8, 12), rates=RATES)
LOSS = LossConfig(perceptual=0)
CONFIG = MetaConfig(
    steps=40,
    segment=3,
    pool=2,
    iterations=(6, 9),
    views=(2, 3),
    novel_views=1,
    learning_rate=1e-2,
    warm_up=4,
    loss=LOSS,
    held_out_loss=LOSS,
)


def _scene(seed: int) -> TrainingScene:
    truth = street_scenes.scene(120, seed)
    views = street_scenes.targets(truth)
    novel = street_scenes.targets(truth, novel=True)
    return TrainingScene(f"s{seed}", street_scenes.blurred(truth), views[:3], views[3:], novel[:2], novel[2:])


def test_training_beats_the_rates_it_starts_from() -> None:
    scenes = [_scene(seed) for seed in range(3)]
    training = MetaTraining(initialise_network(NETWORK, 0), scenes, CONFIG)
    records = [training.step() for _ in range(CONFIG.steps)]
    assert all(torch.isfinite(torch.tensor([r.held_out_loss, r.gradient_norm])).all() for r in records)
    unseen, results = _scene(9), []
    for rule in (TunedAdam(LearningRates.from_sequence(RATES)), training.network.eval()):
        run = unroll(rule, unseen.scene, unseen.source, (), Objective(LOSS), UnrollSettings(8, 3))
        results.append(run.losses[-1])
    assert results[1] < 0.97 * results[0]


def test_a_share_of_the_gaussians_gives_the_gradient_of_all_on_average() -> None:
    network, generator = initialise_network(NETWORK, 0), torch.Generator().manual_seed(0)
    with torch.no_grad():
        network.head.weight.normal_(generator=generator)
    scene = _scene(0)
    config = EpisodeConfig(0, 6, 3, 0, 0.0, 0.0)
    episode = Episode.start(config, scene, network, Objective(LOSS), generator)
    gradient = episode.loop.evaluate().gradients.gaussians
    state, count = episode.state.accumulate(gradient), len(scene.scene)
    inputs = compute_features(episode.parameterization, episode.static_features, state, gradient, 6)

    def gradients(delta: torch.Tensor, rows: torch.Tensor) -> list[torch.Tensor]:
        total = (delta * gradient[rows]).sum() * (count / len(rows))
        return list(torch.autograd.grad(total, list(network.parameters())))

    order = torch.randperm(count, generator=generator)
    whole = network.delta(state, inputs, episode.pyramid, 6)
    full = gradients(whole, torch.arange(count))
    every = network.sampled_delta(state, inputs, episode.pyramid, 6, order)
    torch.testing.assert_close(every, whole[order])
    for ours, theirs in zip(gradients(every, order), full, strict=True):
        torch.testing.assert_close(ours, theirs, rtol=1e-3, atol=1e-6 + 1e-4 * float(theirs.abs().max()))
    halves = [order[: count // 2], order[count // 2 :]]
    parts = [gradients(network.sampled_delta(state, inputs, episode.pyramid, 6, rows), rows) for rows in halves]
    for (name, _), a, b, theirs in zip(network.named_parameters(), *parts, full, strict=True):
        if not name.startswith("entry"):  # there products of two rows' shares come in: right for many Gaussians alone
            torch.testing.assert_close((a + b) / 2, theirs, rtol=1e-3, atol=1e-6 + 1e-4 * float(theirs.abs().max()))


def test_the_step_that_training_differentiates_is_the_one_that_is_made() -> None:
    network, generator = LearnedOptimiser(), torch.Generator().manual_seed(0)
    scene, count = _scene(0), len(_scene(0).scene)
    flat = torch.tensor([0.2, 0.1, 0.01]).log().repeat(count, 1)
    lying = replace(scene.scene.gaussians, log_scales=flat, quats=torch.tensor([1.0, 0, 0, 0]).repeat(count, 1))
    config = EpisodeConfig(0, 6, 3, 0, 0.0, 0.0)
    start = replace(scene, scene=scene.scene.with_gaussians(lying))
    episode = Episode.start(config, start, network, Objective(LOSS), generator)
    ground_constraint = episode.parameterization.ground_constraint
    assert bool((ground_constraint != 0).any())
    gradients = episode.loop.evaluate().gradients
    before = episode.state.offsets
    recorded = episode.record_steps(network, torch.arange(count))
    episode.loop.advance(gradients)
    (differentiable,) = recorded.deltas
    made = episode.state.offsets - before
    free = episode.parameterization.lower == -torch.inf  # attributes without a bound
    torch.testing.assert_close(made[free], differentiable.detach()[free], atol=1e-5, rtol=1e-4)
    ground = (ground_constraint != 0).any(1)
    assert bool((differentiable[ground, 2] == 0).all()) and bool((differentiable[ground, 0] != 0).any())


def _weights(training: MetaTraining) -> list[torch.Tensor]:
    return [p.detach().clone() for p in training.network.parameters()]


def test_resuming_gives_the_same_bytes(tmp_path: Path) -> None:
    scenes = [_scene(seed) for seed in range(2)]
    whole = MetaTraining(initialise_network(NETWORK, 0), scenes, CONFIG)
    for _ in range(5):
        whole.step()
    checkpoint.save(whole, tmp_path / "c.safetensors")
    again = MetaTraining(initialise_network(NETWORK, 1), scenes, CONFIG)
    checkpoint.resume(again, tmp_path / "c.safetensors")
    assert [whole.step() for _ in range(4)] == [again.step() for _ in range(4)]
    for a, b in zip(_weights(whole), _weights(again), strict=True):
        assert torch.equal(a, b)


def test_a_checkpoint_from_before_networks_were_told_residuals_resumes(tmp_path: Path) -> None:
    scenes, path = [_scene(0)], tmp_path / "c.safetensors"
    whole = MetaTraining(initialise_network(NETWORK, 0), scenes, CONFIG)
    whole.step()
    checkpoint.save(whole, path)
    with safe_open(path, "pt") as file:
        described, tensors = json.loads(file.metadata()["training"]), {k: file.get_tensor(k) for k in file.keys()}  # noqa: SIM118
    del described["network"]["residuals"], described["network"]["relaxation"], described["digest"]
    save_file(tensors, path, {"training": json.dumps(described)})
    again = MetaTraining(initialise_network(NETWORK, 1), scenes, CONFIG)
    checkpoint.resume(again, path)
    assert again.done == 1 and whole.step() == again.step()


def test_a_checkpoint_whose_bytes_changed_is_refused(tmp_path: Path) -> None:
    scenes, path = [_scene(0)], tmp_path / "c.safetensors"
    training = MetaTraining(initialise_network(NETWORK, 0), scenes, CONFIG)
    checkpoint.save(training, path)
    data = bytearray(path.read_bytes())
    data[-1] ^= 1
    path.write_bytes(data)
    assert checkpoint.describe(path)["done"] == 0
    before = _weights(training)
    for read in (checkpoint.resume, lambda training, path: checkpoint.load_weights(training.network, path)):
        with pytest.raises(InputError, match=r"bytes have changed since it was written .*c\.safetensors.*Delete it"):
            read(training, path)
    assert all(map(torch.equal, before, _weights(training)))


def test_a_checkpoint_of_other_settings_is_refused(tmp_path: Path) -> None:
    scenes = [_scene(0)]
    checkpoint.save(MetaTraining(initialise_network(NETWORK, 0), scenes, CONFIG), tmp_path / "c.safetensors")
    other = MetaTraining(initialise_network(NETWORK, 0), scenes, CONFIG.model_copy(update={"learning_rate": 1.0}))
    with pytest.raises(InputError, match="other config"):
        checkpoint.resume(other, tmp_path / "c.safetensors")


def test_an_interrupted_training_goes_on_and_writes_its_curve(tmp_path: Path) -> None:
    scenes = [_scene(0)]
    config = CONFIG.model_copy(update={"steps": 4})

    def run(folder: Path, stop: int | None) -> list[torch.Tensor]:
        def progress(done: int, total: int, note: str = "") -> None:
            if done == stop:
                raise KeyboardInterrupt

        network = initialise_network(NETWORK, 0)
        trained = train_optimiser(network, scenes, config, folder, save_every=2, on_checkpoint=watch, progress=progress)
        return [p.clone() for p in trained.parameters()]

    watched: list[int] = []

    def watch(done: int, network: object) -> None:
        watched.append(done)
        if watched == [2, 4, 2, 4]:  # a kill at the last checkpoint
            raise KeyboardInterrupt

    whole = run(tmp_path / "whole", None)
    for stop in (3, None):
        with pytest.raises(KeyboardInterrupt):
            run(tmp_path / "parts", stop)
    assert checkpoint.describe(tmp_path / "parts/checkpoint.safetensors")["done"] == 2
    resumed = run(tmp_path / "parts", None)
    assert all(torch.equal(a, b) for a, b in zip(whole, resumed, strict=True))
    curves = [load_rows(tmp_path / name / "curve.parquet", LEARNING_CURVE) for name in ("whole", "parts")]
    assert watched == [2, 4, 2, 4, 4]
    steps, again = ([{**row, "seconds": 0.0} for row in rows] for rows in curves)
    assert steps == again and [row["step"] for row in steps] == [0, 1, 2, 3]
