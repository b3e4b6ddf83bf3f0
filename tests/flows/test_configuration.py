"""Presets, files and settings merge in order; what is unknown is named with the nearest known key."""

from __future__ import annotations

import itertools
import re
from pathlib import Path
from typing import Any

import pytest
import yaml

from flows.configuration import PRESETS, RENAMED_KEYS, diff_from_preset, load_configuration
from flows.configuration.keys import section_type
from genre_tasks.config import PipelineConfig
from genre_tasks.errors import ConfigError

ROOT = Path(__file__).resolve().parents[2]


@pytest.mark.parametrize("preset", PRESETS)
def test_presets_are_valid(preset: str) -> None:
    config = load_configuration(preset)
    assert config.gnet.iterations == {"fine": 120, "long": 120, "paper": 24}.get(preset, 72)
    enet = {"paper": (12, 0.0), "demo": (72, 0.7), "fine": (96, 0.5), "hd": (100, 0.5)}
    assert (config.enet.iterations, config.enet.split_fraction) == enet.get(preset, (96, 1.0))
    assert config.gnet.refine_iterations == {"demo": 48, "small": 48, "fine": 80, "long": 72, "hd": 48}.get(preset, 0)
    assert diff_from_preset(config, preset) == {}


def test_paper_preset_has_the_papers_numbers() -> None:
    config = load_configuration("paper")
    assert (config.ingest.height_px, config.ingest.width_px) == (720, 1280)
    loss = config.enet.loss
    assert (loss.rgb, loss.perceptual, loss.ssim, loss.depth, loss.novel) == (0.8, 0.2, 0.2, 0.01, 0.5)
    assert config.fnet.timestep == 200 and config.novel_views.shifts_m == (3.0, -3.0)


def test_settings_win_over_file_over_preset(tmp_path: Path) -> None:
    file = tmp_path / "c.yaml"
    file.write_text("gnet: {iterations: 7, seed: 5}\n")
    config = load_configuration("demo", file, ["gnet.iterations=8", "evaluate.shifts_m=[1, 2]"])
    assert (config.gnet.iterations, config.gnet.seed, config.evaluate.shifts_m) == (8, 5, (1.0, 2.0))
    assert diff_from_preset(config, "demo")["gnet.iterations"] == (72, 8)


@pytest.mark.parametrize("section", ["enet.learning_rates", "gnet.refine", "gnet.refine.lr_before_refine"])
def test_a_section_that_is_null_differs_in_all_that_the_preset_has(section: str) -> None:
    differences = diff_from_preset(load_configuration("small", settings=[f"{section}=null"]), "small")
    assert differences and all(key.startswith(f"{section}.") for key in differences)
    assert {after for _, after in differences.values()} == {None}


def test_a_section_that_the_preset_lacks_differs_in_all_that_it_has() -> None:
    rates = "{means: 0.2, log_scales: 0.3, quats: 0.1, logit_opacities: 0.1, colors: 0.01}"
    config = load_configuration("demo", settings=[f"gnet.refine.lr_before_refine={rates}"])
    assert diff_from_preset(config, "demo")["gnet.refine.lr_before_refine.means"] == (None, 0.2)


@pytest.mark.parametrize(
    ("setting", "words"),
    [
        ("gnet.iteration=8", ["gnet.iteration", "Did you mean 'gnet.iterations'"]),
        ("gnte.iterations=8", ["gnte", "Did you mean 'gnet'"]),
        ("gnet.loss.lpisp=1", ["gnet.loss.lpisp"]),
        ("gnet.iterations=0", ["gnet.iterations", "greater than or equal to 1"]),
        ("gnet=8", ["'gnet' is a section"]),
        ("gnet.iterations", ["--set"]),
    ],
)
def test_a_wrong_setting_is_named(setting: str, words: list[str]) -> None:
    with pytest.raises(ConfigError) as caught:
        load_configuration("demo", settings=[setting])
    for word in words:
        assert word in str(caught.value)


def test_unknown_preset_and_file(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="Did you mean 'small'"):
        load_configuration("smal")
    with pytest.raises(ConfigError, match=r"nothing\.yaml"):
        load_configuration("demo", tmp_path / "nothing.yaml")
    broken = tmp_path / "broken.yaml"
    broken.write_text("gnet: [")
    with pytest.raises(ConfigError, match="not YAML"):
        load_configuration("demo", broken)


def test_seeds_do_not_overlap() -> None:
    seeds = yaml.safe_load((ROOT / "configs/seeds.yaml").read_text())
    ranges = [seeds["training"], seeds["validation"], [seeds["demo"]] * 2, seeds["claims"]]
    assert all(a[1] < b[0] for a, b in itertools.pairwise(ranges))
    guide = (ROOT / "docs/guides/training.md").read_text()
    rows = re.findall(r"^\| (\d+)(?:–(\d+))? \| (.*) \|$", guide, flags=re.MULTILINE)
    assert [[int(first), int(last or first)] for first, last, _ in rows] == ranges
    uses = ["training", "validation and tuning", "the demo", "published numbers only"]
    assert [use for _, _, use in rows] == uses


@pytest.mark.parametrize(
    ("setting", "new"),
    [
        ("gnet.finish=null", "gnet.refine"),
        ("gnet.refine.share=0.5", "gnet.refine.fraction_of_iterations"),
        ("enet.rates=[1, 2, 3, 4, 5]", "enet.learning_rates"),
        ("gnet.adam.rates=null", "gnet.adam.learning_rates"),
        ("gnet.per_scene.means_rate=0.1", "gnet.per_scene.means_lr"),
        ("ingest.walls=false", "ingest.complete_facades"),
    ],
)
def test_a_renamed_key_is_an_error_that_names_the_new_key(setting: str, new: str) -> None:
    with pytest.raises(ConfigError, match=rf"was renamed.*Write '{re.escape(new)}'"):
        load_configuration("small", settings=[setting])


def test_every_renamed_key_leads_to_a_key_that_exists() -> None:
    for new in RENAMED_KEYS.values():
        model: Any = PipelineConfig
        for part in new.split("."):
            assert part in model.model_fields, new
            field = model.model_fields[part]
            model, _ = section_type(field.annotation)


def test_a_removed_key_says_what_to_do_instead() -> None:
    with pytest.raises(ConfigError, match=r"was removed.*fnet\.gate"):
        load_configuration("small", settings=["effects.fixer_per_view=off"])
