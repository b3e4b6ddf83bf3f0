"""The baselines of ``configs/baselines.yaml`` as checked configurations of the stage gnet."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from flows.configuration import read_preset, validate_config
from flows.yaml_values import read_yaml_mapping
from genre_tasks.config import GnetConfig
from genre_tasks.errors import ConfigError

FILE = Path(__file__).resolve().parents[2] / "configs" / "baselines.yaml"


@dataclass(frozen=True)
class Baseline:
    """A method to compare with.

    Attributes:
        name: its key in the file.
        source: where it comes from.
        why: why it is configured so.
        variants: its configuration at each length, by name.
    """

    name: str
    source: str
    why: str
    variants: Mapping[str, GnetConfig]

    def variant(self, name: str) -> GnetConfig:
        """Gives the configuration of one length.

        Raises:
            ConfigError: there is no such variant.
        """
        if name not in self.variants:
            raise ConfigError(
                f"the baseline {self.name} has no variant '{name}'",
                remedy=f"Known: {', '.join(self.variants)}.",
                file=FILE,
            )
        return self.variants[name]


def load_baselines(preset: str, file: Path = FILE) -> dict[str, Baseline]:
    """Reads all baselines on top of a preset.

    Args:
        preset: name of the preset whose section ``gnet`` the baselines change.
        file: the YAML file.

    Returns:
        The baselines by name; one without variants has a single one called ``default``.

    Raises:
        ConfigError: a key is unknown or missing, or a value is out of range.

    >>> sorted(name for name in load_baselines("small") if name.startswith("tuned"))
    ['tuned_adam', 'tuned_adam_split']
    """
    # Baselines share the preset's views and losses, so that only the method differs.
    gnet = read_preset(preset).get("gnet", {})
    baselines = {}
    content = read_yaml_mapping(file, "file of baselines", "baselines", "Install the package again.")
    for name, section in content.values.items():
        # A baseline without its source or reason could not be defended against its authors.
        if missing := {"source", "why", "gnet"} - section.keys():
            raise ConfigError(
                f"the baseline {name} does not say its {', '.join(sorted(missing))}", remedy="Add it.", file=file
            )
        # Some methods have one published length only.
        variants = section.get("variants", {"default": {}})
        # Every variant is checked now, because a long table should not fail at its last row.
        configs = {k: _config({**gnet, **section["gnet"], **v}, f"{file}, {name}, {k}") for k, v in variants.items()}
        baselines[name] = Baseline(name, section["source"], section["why"], configs)
    return baselines


def _config(gnet: Mapping[str, Any], source: str) -> GnetConfig:
    return validate_config({"gnet": gnet}, source).gnet
