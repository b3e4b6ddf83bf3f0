"""Which method a stage is done by, and the table of baselines."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
import torch

from flows.configuration import load_configuration
from flows.paper_tables.baselines import load_baselines
from flows.pipeline.definition import STAGE_BY_NAME, find_weights_file
from genre_tasks.config import (
    AdamConfig,
    DensityConfig,
    GnetConfig,
    LearningRates,
    LossConfig,
    OptimiserConfig,
    PerSceneConfig,
    PipelineConfig,
)
from genre_tasks.errors import ConfigError, InputError
from genre_tasks.learned.learned_optimiser import LearnedOptimiser
from genre_tasks.losses.targets import Target
from genre_tasks.optimiser.state import Parameterization, State
from genre_tasks.optimiser.tuned_adam import ENET_LEARNING_RATES, GNET_LEARNING_RATES, TunedAdam
from genre_tasks.scene.reconstruction import Reconstruction
from genre_tasks.stages import optimise
from genre_tasks.weights import resolve_weights
from tests.optimiser import street_scenes

SHORT = PerSceneConfig(iterations=150, density=DensityConfig(every=10_000, reset_every=15_000))
"""Grows once, in the 50th iteration."""


@pytest.fixture
def views(monkeypatch: pytest.MonkeyPatch) -> tuple[Target, ...]:
    """Served in place of a chunk's own."""
    made = street_scenes.targets(street_scenes.scene())
    monkeypatch.setattr(optimise.targets, "source_targets", lambda chunk, depth: made)
    return made


def _gnet(config: OptimiserConfig) -> Reconstruction:
    return optimise.optimise("gnet", config, None, street_scenes.blurred(street_scenes.scene()), None)  # type: ignore[arg-type]


@pytest.mark.parametrize(("method", "actors"), [("standard_3dgs", 0), ("street_gs", 1)])
def test_per_scene_methods_with_and_without_actors(method: str, actors: int, views: tuple[Target, ...]) -> None:
    result = _gnet(GnetConfig(method=method, per_scene=SHORT, snapshots=2))  # type: ignore[arg-type]
    assert len(result.losses) == 150 and min(result.losses[-4:]) < 0.8 * result.losses[0]
    assert sorted(result.snapshots) == [50, 100]
    assert len(result.scene.actors) == actors == len(result.snapshots[50].actors)
    assert len(result.scene) > len(street_scenes.scene())


def test_the_published_recipe_is_the_default() -> None:
    c = PerSceneConfig()
    assert (c.iterations, c.means_lr, c.means_lr * c.means_lr_end_fraction) == (30_000, 1.6e-4, pytest.approx(1.6e-6))
    assert (c.log_scales_lr, c.quats_lr, c.logit_opacities_lr, c.sh_lr) == (5e-3, 1e-3, 5e-2, 2.5e-3)
    assert (c.rgb, c.ssim) == (0.8, 0.2)
    d = c.density
    assert (d.start, d.stop, d.every, d.reset_every) == (500, 15_000, 100, 3000)
    assert (d.grow_gradient, d.grow_scale, d.prune_opacity, d.prune_scale) == (2e-4, 0.01, 0.005, 0.1)


@pytest.mark.parametrize("method", ["standard_3dgs", "street_gs", "g3r"])
def test_only_gnet_can_be_replaced_by_what_knows_no_fixed_views(method: str) -> None:
    assert load_configuration("small", settings=[f"gnet.method={method}"]).gnet.method == method
    with pytest.raises(ConfigError, match=r"enet.method is not allowed.*'learned' or 'adam'"):
        load_configuration("small", settings=[f"enet.method={method}"])


@pytest.mark.parametrize("stage", ["gnet", "enet"])
def test_the_learned_optimisers_rates_are_the_weights_own_or_those_that_are_given(stage: optimise.StageName) -> None:
    config = GnetConfig() if stage == "gnet" else OptimiserConfig()
    own = optimise.load_step_rule(stage, config)
    assert isinstance(own, LearnedOptimiser)
    given = optimise.load_step_rule(
        stage, config.model_copy(update={"learning_rates": LearningRates.from_sequence((0.5, 0.4, 0.3, 0.2, 0.0))})
    )
    assert isinstance(given, LearnedOptimiser) and given.config.rates == (0.5, 0.4, 0.3, 0.2, 0.0) != own.config.rates
    assert given.config.relaxation == own.config.relaxation
    assert all(torch.equal(a, b) for a, b in zip(own.parameters(), given.parameters(), strict=True))
    assert not any(p.requires_grad for p in given.parameters())


def test_g3r_has_weights_of_its_own_or_those_that_are_named(views: tuple[Target, ...]) -> None:
    own = GnetConfig(method="g3r", iterations=2, views_per_iteration=2, loss=LossConfig(perceptual=0.0))
    weights = str(resolve_weights("gnet", "builtin"))
    named = own.model_copy(update={"weights": weights})
    g3r, gnet = _gnet(own).scene.gaussians.pack(), _gnet(named).scene.gaussians.pack()
    assert not torch.equal(g3r, gnet)
    assert torch.equal(gnet, _gnet(named.model_copy(update={"method": "learned"})).scene.gaussians.pack())
    spec = STAGE_BY_NAME["gnet"]
    assert find_weights_file(spec, PipelineConfig(gnet=named)) == Path(weights)  # its bytes are part of the key
    assert find_weights_file(spec, PipelineConfig(gnet=own)) == resolve_weights("g3r", "builtin")
    assert find_weights_file(spec, PipelineConfig(gnet=GnetConfig(method="street_gs"))) is None


def test_adam_takes_the_stages_rates_unless_others_are_set() -> None:
    rules = [optimise.load_step_rule(stage, OptimiserConfig(method="adam")) for stage in ("gnet", "enet")]
    assert rules == [TunedAdam(GNET_LEARNING_RATES), TunedAdam(ENET_LEARNING_RATES)]
    rates = LearningRates.from_sequence((1, 2, 3, 4, 5))
    adam = AdamConfig(learning_rates=rates, schedule="constant")
    assert optimise.load_step_rule("enet", OptimiserConfig(method="adam", adam=adam)) == TunedAdam(rates, "constant")


def test_a_constant_schedule_steps_as_far_at_the_end_as_a_cosine_at_the_start() -> None:
    scene = street_scenes.scene()
    gradient = torch.randn(len(scene), 14, generator=torch.Generator().manual_seed(0))
    state, parameterization = State.zeros(len(scene), gradient).accumulate(gradient), Parameterization.from_scene(scene)
    late = replace(state, iteration=24)
    cosine, constant = (TunedAdam(schedule=d).prepare(parameterization, torch.zeros(3)) for d in ("cosine", "constant"))
    assert torch.equal(constant(late, gradient, 24), cosine(state, gradient, 24))
    assert torch.allclose(cosine(late, gradient, 24), 0.05 * cosine(state, gradient, 24))


@pytest.mark.parametrize("preset", ["demo", "small", "paper"])
def test_the_table_of_baselines_is_sound(preset: str) -> None:
    table = load_baselines(preset)
    adam = {"tuned_adam", "tuned_adam_split"}
    assert set(table) == {"standard_3dgs", "street_gs", "g3r"} | adam
    methods = {name: {c.method for c in b.variants.values()} for name, b in table.items()}
    assert methods == {n: {"adam" if n in adam else n} for n in table}
    gnet = load_configuration(preset).gnet
    for name, baseline in table.items():
        assert baseline.source and baseline.why
        for variant, config in baseline.variants.items():
            assert config.loss == gnet.loss  # the same objective, where it is the stage's own
            if name in adam:
                share = f"+{config.split_fraction:.0%}" if config.split_fraction else ""
                assert f"{config.iterations}x{config.views_per_iteration}{share}" == variant
                assert config.adam.learning_rates is not None and bool(share) == name.endswith("split")
            elif "3" in name or name == "street_gs":
                assert variant in ("default", str(config.per_scene.iterations))
    with pytest.raises(ConfigError, match=r"no variant '1'.*Known: 30000"):
        table["standard_3dgs"].variant("1")


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("a: {source: s, gnet: {}}", "does not say its why"),
        ("a: {source: s, why: w, gnet: {methode: adam}}", "Did you mean 'gnet.method'"),
        ("a: {source: s, why: w, gnet: {method: adamant}}", "gnet.method is not allowed"),
        ("a: {source: s, why: w, gnet: {}, variants: {x: {per_scene: {density: {evry: 1}}}}}", "density.evry"),
    ],
)
def test_mistakes_in_the_table_are_named(text: str, said: str, tmp_path: Path) -> None:
    (tmp_path / "b.yaml").write_text(text)
    with pytest.raises(ConfigError, match=said):
        load_baselines("small", tmp_path / "b.yaml")


def test_a_stage_can_run_with_the_weights_that_ship_for_another() -> None:
    assert resolve_weights("enet", "builtin:gnet") == resolve_weights("gnet", "builtin")
    enet = PipelineConfig(enet=OptimiserConfig(weights="builtin:gnet"))
    assert find_weights_file(STAGE_BY_NAME["enet"], enet) == resolve_weights("gnet", "builtin")
    with pytest.raises(InputError, match=r"do not exist.*Those of enet, fnet, g3r, gnet ship"):
        resolve_weights("enet", "builtin:hnet")
