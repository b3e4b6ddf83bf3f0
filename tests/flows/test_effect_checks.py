"""Effects that are set on, and that other settings leave out, are refused before a run."""

from __future__ import annotations

from pathlib import Path

import pytest

from flows.configuration import load_configuration
from flows.preflight.effect_checks import SINGLE_COLOR_METHODS, check_effects
from flows.preflight.requirements import check_requirements
from genre_tasks.errors import ConfigError
from genre_tasks.stages.optimise import PER_SCENE_METHODS

LOG = "synthetic:street?seed=900&frames=8&cameras=1&width=64&height=36&lidar_beams=32&lidar_azimuths=300"


def check(*settings: str) -> None:
    check_effects(load_configuration("demo", settings=settings))


def test_methods_are_those_of_the_stage() -> None:
    assert set(SINGLE_COLOR_METHODS) == {"none", *PER_SCENE_METHODS}


@pytest.mark.parametrize(
    ("settings", "problem"),
    [
        (("initial.scene=a.ply", "anti_aliasing"), "initial.scene leaves it out"),
        (("initial.scene=a.ply", "nonrigid_actors"), "initial.scene leaves it out"),
        (("gnet.method=none", "view_dependent_colour"), "gnet.method=none leaves it out"),
        (("gnet.method=street_gs", "view_dependent_colour"), "gnet.method=street_gs leaves it out"),
        (("gnet.method=standard_3dgs", "nonrigid_actors"), "gnet.method=standard_3dgs leaves it out"),
        (("effects.rigid_actors=off", "nonrigid_actors"), "effects.rigid_actors=off leaves it out"),
    ],
)
def test_what_would_be_left_out_is_refused(settings: tuple[str, str], problem: str) -> None:
    other, effect = settings
    with pytest.raises(ConfigError, match=f"^effects.{effect} is set on, and {problem}.*Set effects.{effect} to off"):
        check(other, f"effects.{effect}=on")
    # Each of the two alone is sound, and so is a plan that decides.
    check(other)
    check(f"effects.{effect}=on")
    check(other, f"effects.{effect}=auto")


def test_all_of_them_are_named() -> None:
    both = "effects.nonrigid_actors and effects.anti_aliasing are set on, and initial.scene leaves them out"
    with pytest.raises(ConfigError, match=both):
        check("effects=on", "initial.scene=a.ply")
    check("effects=on")
    check("effects=none", "gnet.method=street_gs", "initial.scene=a.ply")


def test_a_run_is_refused_before_its_log_is_opened(tmp_path: Path) -> None:
    config = load_configuration("demo", settings=["gnet.method=street_gs", "effects.view_dependent_colour=on"])
    with pytest.raises(ConfigError, match=r"gnet.method=street_gs leaves it out"):
        check_requirements("pandaset:nowhere", str(tmp_path), None, config)
    check_requirements(LOG, str(tmp_path), None, load_configuration("demo", settings=["effects.anti_aliasing=on"]))
