"""The baselines of ``configs/baselines.yaml`` as checked configurations of the stage gnet."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml

from flows.configuration import preset_values, validated
from genre_tasks.config import GnetConfig
from genre_tasks.errors import ConfigError

FILE = Path(__file__).resolve().parents[2] / "configs" / "baselines.yaml"


@dataclass(frozen=True)
class Baseline:
    """A method to compare with: where it comes from, why it is done so, and its configuration at each length."""

    name: str
    source: str
    why: str
    variants: Mapping[str, GnetConfig]

    def at(self, variant: str) -> GnetConfig:
        """The configuration of one length. Raises ``ConfigError`` for one that there is not."""
        if variant not in self.variants:
            raise ConfigError(
                f"the baseline {self.name} has no variant '{variant}'",
                remedy=f"Known: {', '.join(self.variants)}.",
                file=FILE,
            )
        return self.variants[variant]


def load_baselines(preset: str, file: Path = FILE) -> dict[str, Baseline]:
    """All baselines on top of a preset; one without variants has the one called ``default``.

    Raises ``ConfigError`` for an unknown key or a value out of range.
    """
    gnet = preset_values(preset).get("gnet", {})
    out = {}
    for name, section in yaml.safe_load(file.read_text(encoding="utf-8")).items():
        if missing := {"source", "why", "gnet"} - section.keys():
            raise ConfigError(
                f"the baseline {name} does not say its {', '.join(sorted(missing))}", remedy="Add it.", file=file
            )
        variants = section.get("variants", {"default": {}})
        configs = {k: _config({**gnet, **section["gnet"], **v}, f"{file}, {name}, {k}") for k, v in variants.items()}
        out[name] = Baseline(name, section["source"], section["why"], configs)
    return out


def _config(gnet: Mapping[str, Any], source: str) -> GnetConfig:
    return validated({"gnet": gnet}, source).gnet
