"""A method that tables compare: a few settings over a preset, and the stage where it ends."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

from flows.configuration import load_configuration
from flows.experiments.stage_prediction import PER_SCENE_METHODS
from flows.paper_tables.weights_slots import SLOTS
from genre_tasks.config import PipelineConfig
from genre_tasks.errors import ConfigError

End = Literal["gnet", "enet", "fnet"]
_REFERENCE = re.compile(r"\{([a-z_.]+)\}")


@dataclass(frozen=True)
class Method:
    """The recipe of a table's row.

    Attributes:
        name: label of the row.
        settings: ``section.key=value`` over everything else; ``{section.key}`` in one stands for the value that the
            configuration has by then.
        end: the stage whose scene (``fnet``: whose images) is the result.
        note: what the reader of the table should know.
        slot: name of weights that the user may give, see ``SLOTS``.
        needs_weights: whether the method cannot do without them.
        stand_in: what is in their place where they are not given.
    """

    name: str
    settings: tuple[str, ...]
    end: End = "enet"
    note: str = ""
    slot: str = ""
    needs_weights: bool = False
    stand_in: str = ""

    def configuration(self, preset: str, settings: Sequence[str]) -> PipelineConfig:
        """Builds the configuration of this method.

        Args:
            preset: name of the preset.
            settings: ``section.key=value`` over the preset, such as a table's protocol; the method's come after them.

        Raises:
            ConfigError: a setting is unknown or out of range.

        >>> Method("GNet, 24 iterations", ("gnet.iterations=24",)).configuration("small", ()).gnet.iterations
        24
        """
        # One after the other, because a reference may name a key that an earlier setting of the method has changed.
        applied = list(settings)
        for setting in self.settings:
            applied.append(_resolve_references(setting, preset, applied))
        config = load_configuration(preset, settings=applied)
        if config.gnet.method in PER_SCENE_METHODS:
            return config
        # Per-scene settings are part of GNet's key though GNet ignores them: with the preset's, tables of other
        # lengths of per-scene training share GNet's stages.
        gnet = config.gnet.model_copy(update={"per_scene": load_configuration(preset).gnet.per_scene})
        return config.model_copy(update={"gnet": gnet})

    def with_weights(self, weights: Mapping[str, str]) -> Method:
        """Puts in the weights that the user gives.

        Args:
            weights: slot → path.

        Returns:
            The method with these weights and a note that names them, or with a note on what stands in for them.
        """
        if not self.slot:
            return self
        if self.slot not in weights:
            # The stand-in is named in the table, as its numbers are not those of the published fixer.
            return replace(self, note=_join(self.note, self.stand_in))
        path = weights[self.slot]
        note = _join(self.note, f"Weights given: {Path(path).name}.")
        # As JSON, because a path may hold characters that YAML reads as syntax.
        setting = f"{SLOTS[self.slot].key}={json.dumps(path)}"
        return replace(self, settings=(*self.settings, setting), note=note, slot="", needs_weights=False)


def _join(*sentences: str) -> str:
    return " ".join(s for s in sentences if s)


def _resolve_references(setting: str, preset: str, before: Sequence[str]) -> str:
    """Replaces each ``{section.key}`` by the value in the configuration so far."""
    # Loading the configuration is slow, and most settings refer to nothing.
    if not _REFERENCE.search(setting):
        return setting
    config = load_configuration(preset, settings=before)

    def value(match: re.Match[str]) -> str:
        found: Any = config
        for part in match[1].split("."):
            # A typo in a method's file should name the setting, not raise an AttributeError.
            if not hasattr(found, part):
                raise ConfigError(
                    f"there is no configuration key {match[1]!r}", remedy=f"Mend the setting {setting!r} of the method."
                )
            found = getattr(found, part)
        return json.dumps(found)

    return _REFERENCE.sub(value, setting)
