"""Refuses effects that are set on where other settings leave them out, so that a plan does not promise them."""

from __future__ import annotations

from collections.abc import Iterator

from genre_tasks.config import PipelineConfig
from genre_tasks.errors import ConfigError

# As the stage ``initial``, which adds neither to Gaussians that it takes from a file.
_LEFT_OUT_OF_FILES = ("nonrigid_actors", "anti_aliasing")

# As ``PER_SCENE_METHODS`` of the stage, whose module loads torch; a test compares the two.
SINGLE_COLOR_METHODS = ("none", "standard_3dgs", "street_gs")
"""Methods of GNet that fit neither shapes of actors nor view-dependent colours."""

_LEFT_OUT_OF_METHODS = ("nonrigid_actors", "view_dependent_colour")


def check_effects(config: PipelineConfig) -> None:
    """Checks that every effect that is set on has a place in what the other settings ask for.

    Effects at auto are left to the plan of each chunk.

    Args:
        config: the effective configuration.

    Raises:
        ConfigError: an effect is set on, and would be left out without a word.

    >>> from flows.configuration import load_configuration
    >>> check_effects(load_configuration("demo", settings=["gnet.method=none", "effects.view_dependent_colour=on"]))
    Traceback (most recent call last):
    genre_tasks.errors.ConfigError: effects.view_dependent_colour is set on, and gnet.method=none leaves it out: …
    """
    for key, reason, left_out in _list_exclusions(config):
        names = [f"effects.{name}" for name in left_out if getattr(config.effects, name) == "on"]
        if names:
            are = "is" if len(names) == 1 else "are"
            them = "it" if len(names) == 1 else "them"
            raise ConfigError(
                f"{' and '.join(names)} {are} set on, and {key} leaves {them} out: {reason}",
                remedy=f"Set {' and '.join(names)} to off, or change {key.partition('=')[0]}.",
            )


def _list_exclusions(config: PipelineConfig) -> Iterator[tuple[str, str, tuple[str, ...]]]:
    """Settings that leave effects out: the setting, why, and the effects."""
    if config.initial.scene is not None:
        reason = "Gaussians of a file have no actors, and the anti-aliasing that the file states"
        yield "initial.scene", reason, _LEFT_OUT_OF_FILES
    if config.gnet.method in SINGLE_COLOR_METHODS:
        reason = "the method fits neither shapes of actors nor view-dependent colours"
        yield f"gnet.method={config.gnet.method}", reason, _LEFT_OUT_OF_METHODS
    if config.effects.rigid_actors == "off":
        yield "effects.rigid_actors=off", "nothing is an actor that could change its shape", ("nonrigid_actors",)
