"""The tables behind the weights: their order is sound, and they say what the model cards say."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import pytest
import yaml

from benchmarks.real_logs import RealLogsBench
from flows.configuration import load_configuration
from flows.training import recipes, validation
from flows.training.device import choose_device
from flows.training.fixer_job import FixerJob
from flows.training.fixer_pairs import TRAINING_PAIRS, list_pair_scenes, list_validation_scenes
from flows.training.recipes import GNET_STAGES, get_recipe, select_stages
from flows.training.scene_starts import Adam, ByGnet, PerScene
from flows.training.stage_scenes import list_stage_scenes
from flows.training.training_scenes import TRAINING_SEEDS
from flows.training.validation import list_validation_recipes
from genre_tasks.errors import ConfigError
from genre_tasks.fixer.inference import TILE_PX
from genre_tasks.learned.weights import load_optimiser
from genre_tasks.weights import resolve_weights

ROOT = Path(__file__).resolve().parents[2]
REAL = "pandaset:002"


@pytest.mark.parametrize("recipe", recipes.RECIPES)
def test_every_recipe_is_in_order_and_of_training_chunks(recipe: str) -> None:
    table = get_recipe(recipe)
    assert {stage.network_name for stage in table} == ({"gnet"} if recipe == "effects" else {"gnet", "enet"})
    for stage in table:
        at = list_stage_scenes(stage, REAL)
        assert len(at) == stage.scenes.rounds * len(
            list_stage_scenes(replace(stage, scenes=replace(stage.scenes, rounds=1)), REAL)
        )
        assert [r.uri.count("seed=90") for r in list_validation_recipes(stage.scenes)] == [1, 1, 1]


def test_the_shipped_weights_are_described() -> None:
    table = {stage.name: stage for stage in get_recipe("shipped")}
    assert [table[s.name].config.steps for s in GNET_STAGES] == [1200, 240, 240, 200, 110, 420, 0]
    streets = [len(list_stage_scenes(table[name], None)) for name in ("gnet/coarse", "gnet/fine", "enet/coarse")]
    assert streets == [40, 15, 24]
    assert len(list_stage_scenes(table["gnet/many"], REAL)) == 15 + 4
    assert len(list_stage_scenes(table["gnet/dense"], REAL)) == 28 + 9
    begins = [scene.start for scene in list_stage_scenes(table["enet/fine"], REAL)]
    gnet = ByGnet("gnet/fine")
    assert begins[:6] == [gnet, gnet, Adam(24), gnet, gnet, Adam(48)]
    names = [stage.name for stage in select_stages(get_recipe("shipped"), "enet")]
    gnet = ["gnet/coarse", "gnet/fine", "gnet/finer", "gnet/unseen", "gnet/many", "gnet/dense"]
    assert table["gnet/told"].network == load_optimiser(resolve_weights("gnet", "builtin")).config
    assert table["gnet/told"].network == load_optimiser(resolve_weights("g3r", "builtin")).config
    enet = ["enet/coarse", "enet/fine", "enet/dense", "enet/strides", "enet/held", "enet/many"]
    assert names == [*gnet, "gnet/told", *enet, "enet/swept"]
    assert table["enet/swept"].network == load_optimiser(resolve_weights("enet", "builtin")).config


def _percentages(counts: dict[str, int]) -> dict[str, str]:
    return {kind: f"{100 * count / sum(counts.values()):.0f} %" for kind, count in counts.items()}


def test_the_fixers_card_has_the_fractions_of_its_pairs() -> None:
    card = resolve_weights("fnet", "builtin").with_suffix(".md").read_text()
    uris = [scene.uri for scene in list_pair_scenes(FixerJob("training").streets, REAL)]
    real = uris.count(REAL)
    today = {s.kind: (len(uris) - real) * s.count + real * s.real for s in TRAINING_PAIRS.sets}
    # The shipped weights' first two trainings came before this kind.
    earlier = {kind: count for kind, count in today.items() if kind != "loose ground"}
    assert f"makes {sum(today.values())} pairs" in card and f"had {sum(earlier.values())}" in card
    rows = re.findall(r"^\| ([\w -]+) \| (\d+ %|–) \| (\d+ %) \|", card, flags=re.MULTILINE)
    expected = _percentages(earlier) | {"loose ground": "–"}
    assert {kind: first for kind, first, _ in rows} == expected
    assert {kind: last for kind, _, last in rows} == _percentages(today)
    for input_name in ("render", "nearest recorded image", "LiDAR map"):
        assert re.search(rf"^\| input \|.*{input_name}", card, flags=re.MULTILINE)
    assert f"to {load_configuration('hd').fnet.max_network_px} pixels" in card and f"Above {TILE_PX} pixels" in card


def test_seeds_are_those_of_the_configuration() -> None:
    seeds = yaml.safe_load((ROOT / "configs/seeds.yaml").read_text())
    first, last = seeds["training"]
    assert range(first, last + 1) == TRAINING_SEEDS
    lowest, highest = seeds["validation"]
    uris = [scene.uri for scene in list_validation_scenes()]
    used = [*validation.SEEDS, *(int(uri.partition("seed=")[2]) for uri in uris)]
    assert len(used) == 6 and all(lowest <= seed <= highest for seed in used)


def test_the_guide_says_which_recordings_are_not_for_training() -> None:
    guide = (ROOT / "docs/guides/training.md").read_text()
    drive = Path(RealLogsBench.options["kitti"].partition("?")[0]).name
    assert re.search(rf"^\| KITTI `{drive}` \| .*never training \|$", guide, flags=re.MULTILINE)
    assert re.search(r"^\| PandaSet 002, chunk 1 \| published numbers only \|$", guide, flags=re.MULTILINE)


def test_the_paper_begins_with_enet() -> None:
    names = [stage.name for stage in select_stages(get_recipe("paper"), "gnet")]
    assert names == ["enet/coarse_3dgs", "enet/3dgs", "gnet/coarse", "gnet/fine"]


@pytest.mark.parametrize("recipe", recipes.RECIPES)
def test_g3r_sees_recorded_views_alone(recipe: str) -> None:
    table = get_recipe(recipe, novel=0)
    assert {stage.network_name for stage in table} == {"g3r"}
    for stage in table:
        assert stage.config.held_out_loss.novel == 0 and stage.config.novel_views == 0 and stage.fixed_images is None
        assert all(name.startswith("g3r/") for name in stage.required_stages())
    assert get_recipe(recipe, novel=0.2)[-1].name == get_recipe(recipe)[-1].name


def test_training_with_effects_and_without_differ_in_the_scenes_alone() -> None:
    plain, effects = get_recipe("effects")
    assert plain.config == effects.config and plain.initial_weights == effects.initial_weights == "builtin:gnet"
    assert plain.required_stages() == effects.required_stages() == ()
    pairs = list(zip(list_stage_scenes(plain, REAL), list_stage_scenes(effects, REAL), strict=True))
    assert all(b.recipe == replace(a.recipe, uri=b.recipe.uri, planned=True) for a, b in pairs)
    assert all(b.recipe.uri.startswith(a.recipe.uri) and a.start == b.start for a, b in pairs)
    counts = [sum(name in b.recipe.uri for _, b in pairs) for name in ("rolling", "distortion", "exposure", "bonnet")]
    assert counts == sorted(counts, reverse=True) and counts[-1] > 0
    assert any(a.recipe.uri == b.recipe.uri for a, b in pairs if "street" in a.recipe.uri)


def test_a_table_out_of_order_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(recipes, "RECIPES", {"turned": tuple(reversed(GNET_STAGES)), "twice": 2 * GNET_STAGES[:1]})
    with pytest.raises(ConfigError, match="gnet/told needs gnet/dense"):
        get_recipe("turned")
    with pytest.raises(ConfigError, match="two stages are called gnet/coarse"):
        get_recipe("twice")


def test_an_age_beyond_its_run_is_refused() -> None:
    with pytest.raises(ConfigError, match=r"standard_3dgs@9/8"):
        PerScene(9, 8)


def test_devices(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("torch.cuda.is_available", lambda: False)
    assert choose_device("cpu").type == "cpu"
    with pytest.raises(ConfigError, match="Give auto, cpu or cuda"):
        choose_device("tpu")
