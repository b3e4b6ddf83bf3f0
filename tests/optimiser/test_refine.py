"""GNet with an end of its own, split and with other weights: one scene, one key, one way in benchmark and stage."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
import torch

from benchmarks.common.task import OptimisationTask
from benchmarks.optimiser import race
from flows.configuration import load_configuration
from flows.pipeline.definition import STAGE_BY_NAME, digest_stage_weights, digest_weights
from genre_tasks.config import (
    GnetConfig,
    IngestConfig,
    InitialConfig,
    LearningRates,
    LossConfig,
    PipelineConfig,
    RefineConfig,
)
from genre_tasks.errors import ConfigError, InputError
from genre_tasks.learned.weights import load_optimiser
from genre_tasks.logs.registry import open_log
from genre_tasks.losses.targets import source_targets
from genre_tasks.scene.chunk import Chunk
from genre_tasks.scene.deformation import Deformation
from genre_tasks.scene.graph import SceneGraph
from genre_tasks.stages.ingest import ingest
from genre_tasks.stages.initial import initial
from genre_tasks.stages.optimise import make_refine_settings, make_unroll_settings, optimise
from genre_tasks.weights import resolve_weights

LOG = "synthetic:street?seed=903&width=96&height=54&samples=1&lidar_beams=32&lidar_azimuths=450&frames=9&cameras=2"
FINISH = RefineConfig(fraction_of_iterations=1 / 3, split_fraction=0.3)
CONFIG = GnetConfig(iterations=12, views_per_iteration=2, loss=LossConfig(perceptual=0.0), snapshots=3, refine=FINISH)


@pytest.fixture(scope="module")
def chunk() -> Chunk:
    return ingest(IngestConfig(width_px=96, height_px=54), open_log(LOG), 0)


@pytest.fixture(scope="module")
def start(chunk: Chunk) -> SceneGraph:
    return initial(InitialConfig(max_points=3000, distant_count=300), chunk).scene


def _packed(scene: SceneGraph) -> torch.Tensor:
    return scene.gaussians.pack()


def test_the_end_is_a_run_of_its_own_from_the_scene_that_the_first_left(chunk: Chunk, start: SceneGraph) -> None:
    shown: list[tuple[int, int]] = []
    found = optimise("gnet", CONFIG, chunk, start, None, lambda done, total, _: shown.append((done, total)))
    first = optimise("gnet", CONFIG.model_copy(update={"iterations": 8, "refine": None}), chunk, start, None)
    alone = CONFIG.model_copy(
        update={"iterations": 4, "seed": 1, "split_fraction": 0.3, "weights": "builtin:enet", "refine": None}
    )
    then = optimise("gnet", alone, chunk, first.scene, None)
    assert torch.equal(_packed(found.scene), _packed(then.scene))
    assert len(found.scene) == len(start) + round(0.3 * len(start))
    assert found.losses == first.losses + then.losses and len(found.seconds_per_iteration) == 12
    assert shown == [(k + 1, 12) for k in range(12)]
    counts = {k: len(scene) for k, scene in sorted(found.snapshots.items())}
    assert counts == {3: len(start), 5: len(start), 10: len(found.scene)}


def test_the_benchmark_goes_the_same_way(chunk: Chunk, start: SceneGraph) -> None:
    task = OptimisationTask(start, source_targets(chunk, depth=True), ())
    end = race.take_last(race.gnet_steps(task, CONFIG, CONFIG.seed), CONFIG.iterations)
    assert torch.equal(_packed(end.scene), _packed(optimise("gnet", CONFIG, chunk, start, None).scene))
    views = len(task.source)  # all of them are rendered once more for the split
    assert (end.iteration, end.renders) == (12, 24 + views) and end.seconds > 0
    quarters = race.run_learned(replace(task, heldout=task.source[:1]), CONFIG, 0)
    assert [p.renders for p in quarters] == [0, 6, 12, 18 + views, 24 + views]


def test_both_weights_are_part_of_the_key(tmp_path: Path) -> None:
    spec = STAGE_BY_NAME["gnet"]
    plain, own = PipelineConfig(gnet=CONFIG.model_copy(update={"refine": None})), PipelineConfig(gnet=CONFIG)
    gnet = digest_weights(resolve_weights("gnet", "builtin"))
    assert digest_stage_weights(spec, plain) == gnet
    other = FINISH.model_copy(update={"weights": "builtin:gnet"})
    digests = {
        gnet,
        *(
            digest_stage_weights(spec, PipelineConfig(gnet=CONFIG.model_copy(update={"refine": f})))
            for f in (FINISH, other)
        ),
    }
    assert len(digests) == 3 and digest_stage_weights(spec, own) in digests
    missing = FINISH.model_copy(update={"weights": str(tmp_path / "none.safetensors")})
    with pytest.raises(InputError, match=r"none\.safetensors"):
        digest_stage_weights(spec, PipelineConfig(gnet=CONFIG.model_copy(update={"refine": missing})))


def test_a_baseline_in_its_place_has_nothing_of_it(chunk: Chunk, start: SceneGraph) -> None:
    adam = CONFIG.model_copy(update={"method": "adam"})
    found = optimise("gnet", adam, chunk, start, None)
    assert adam.refinement is None and (adam.refine_iterations, len(found.losses)) == (0, 12)
    assert (
        len(found.scene) == len(start)
        and digest_stage_weights(STAGE_BY_NAME["gnet"], PipelineConfig(gnet=adam)) is None
    )


def test_snapshots_are_shared_out_by_length() -> None:
    long = load_configuration("long").gnet
    assert long.refinement is not None
    plans = make_unroll_settings("gnet", long), make_refine_settings(long, long.refinement)
    assert [p.iterations for p in plans] == [48, 72] and sum(p.snapshots for p in plans) == long.snapshots
    assert [p.split_fraction for p in plans] == [0.0, 0.3] and plans[0].seed != plans[1].seed


def test_the_end_is_a_share_of_any_length() -> None:
    def parts(iterations: int, share: float) -> tuple[int, int]:
        config = GnetConfig(iterations=iterations, refine=RefineConfig(fraction_of_iterations=share))
        return make_unroll_settings("gnet", config).iterations, config.refine_iterations

    assert [parts(n, 2 / 3) for n in (1, 2, 3, 8, 72, 144)] == [(1, 0), (1, 1), (1, 2), (3, 5), (24, 48), (48, 96)]
    assert parts(10, 0.99) == (1, 9) and parts(10, 0.01) == (9, 1)
    assert GnetConfig(iterations=8).refine_iterations == 0


def test_rates_of_the_first_iterations_are_the_ends_to_say(chunk: Chunk, start: SceneGraph) -> None:
    def at(config: GnetConfig) -> torch.Tensor:
        return _packed(optimise("gnet", config, chunk, start, None).scene)

    def told(rates: tuple[float, ...], **more: object) -> GnetConfig:
        before = LearningRates.from_sequence(rates)
        finish = RefineConfig.model_validate({**FINISH.model_dump(), "lr_before_refine": before})
        return CONFIG.model_copy(update={"refine": finish, **more})

    own = load_optimiser(resolve_weights("gnet", "builtin")).config.rates
    plain = at(CONFIG)
    assert torch.equal(at(told(own)), plain) and not torch.equal(at(told((4 * own[0], *own[1:]))), plain)
    task = OptimisationTask(start, source_targets(chunk, depth=True), ())
    bold = told((4 * own[0], *own[1:]))
    end = race.take_last(race.gnet_steps(task, bold, bold.seed), bold.iterations)
    assert torch.equal(_packed(end.scene), at(bold))
    assert torch.equal(at(told((9.0, *own[1:]), iterations=1)), at(CONFIG.model_copy(update={"iterations": 1})))
    for bad in ((-0.1, 1, 1, 1, 1), (float("nan"), 1, 1, 1, 1), (1, 1, 1)):
        with pytest.raises(ValueError, match=r"means|shorter"):
            told(bad)


def test_weights_unfit_for_the_end_are_said_before_the_first_iteration(
    chunk: Chunk, start: SceneGraph, tmp_path: Path
) -> None:
    (bad := tmp_path / "bad.safetensors").write_bytes(b"no weights")
    config, shown = CONFIG.model_copy(update={"refine": FINISH.model_copy(update={"weights": str(bad)})}), []
    with pytest.raises(InputError, match=r"bad\.json"):
        optimise("gnet", config, chunk, start, None, lambda done, total, _: shown.append(done))
    assert not shown


def test_one_setting_gives_a_preset_an_end() -> None:
    plain = load_configuration("paper")
    assert plain.gnet.refine is None
    ending = load_configuration("paper", settings=["gnet.refine.split_fraction=0.5"]).gnet
    assert ending.refinement == RefineConfig(split_fraction=0.5)
    assert load_configuration("long", settings=["gnet.refine=null"]).gnet.refine_iterations == 0
    with pytest.raises(ConfigError, match="fraction_of_iterations"):
        load_configuration("long", settings=["gnet.refine.fraction_of_iterations=1.5"])


def test_actors_that_deform_and_gloss_go_through_the_split(chunk: Chunk, start: SceneGraph) -> None:
    rows = len(start)
    frames = tuple(sorted({v.frame for v in chunk.views_with_role("source")}))
    deforming = Deformation.zero(start.actors, (0,), frames)
    found = optimise(
        "gnet", CONFIG, chunk, replace(start, spherical_harmonics=torch.zeros(rows, 8, 3), deformation=deforming), None
    )
    assert found.scene.spherical_harmonics is not None and found.scene.deformation is not None
    assert len(found.scene) == rows + round(0.3 * rows) and found.scene.spherical_harmonics.shape == (
        len(found.scene),
        8,
        3,
    )
    assert bool((found.scene.spherical_harmonics != 0).any()) and bool((found.scene.deformation.offsets != 0).any())
    then = found.snapshots[10].deformation
    assert then is not None and not torch.equal(then.offsets, found.scene.deformation.offsets)
