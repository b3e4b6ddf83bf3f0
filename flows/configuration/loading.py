"""Merges presets, files and single settings; later ones win, and each value remembers where it comes from."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Literal

from flows.configuration.keys import Place, Places, describe_value
from flows.configuration.settings import parse_setting
from flows.configuration.validation import validate_config
from flows.yaml_values import read_yaml_mapping
from genre_tasks.config import EffectsConfig, PipelineConfig
from genre_tasks.errors import ConfigError
from genre_tasks.suggestions import did_you_mean

PRESETS = ("demo", "small", "fine", "long", "hd", "paper")
_PRESET_FOLDER = Path(__file__).resolve().parents[2] / "configs"


def load_configuration(preset: str, file: Path | None = None, settings: Sequence[str] = ()) -> PipelineConfig:
    """Merges a preset, a file and single settings into the configuration of a run; later ones win.

    Args:
        preset: one of :data:`PRESETS`.
        file: a YAML file with sections as in ``configs/``; ``None`` for none.
        settings: ``section.key=value`` strings; values are YAML, such as ``[1, 2]`` or ``null``, and text where the
            key takes text.

    Returns:
        The checked configuration.

    Raises:
        ConfigError: a preset, file or key does not exist (the nearest one is named), or a value is not allowed.

    >>> load_configuration("demo", settings=["gnet.iterations=8"]).gnet.iterations
    8
    """
    values = read_preset(preset)
    places = Places(Place(f"preset {preset}"), {})
    if file is not None:
        change = read_yaml_mapping(
            file, "configuration file", "sections", "Check --config, and write e.g. 'gnet: {iterations: 8}'."
        )
        values = _merge(values, _expand_effects_word(change.values))
        by_key = {path: Place(str(file), line) for path, line in change.lines.items()}
        places = Places(places.default, by_key)
    return _apply(settings, values, places)


def apply_settings(config: PipelineConfig, settings: Sequence[str]) -> PipelineConfig:
    """Changes single values of a configuration.

    Args:
        config: the configuration, which stays as it is.
        settings: ``section.key=value`` strings, as for :func:`load_configuration`.

    Returns:
        The changed configuration.

    Raises:
        ConfigError: a key does not exist, or a value is not allowed.

    >>> apply_settings(PipelineConfig(), ["enet.iterations=2", "enet.seed=7"]).enet.seed
    7
    """
    # By way of plain values, so that changed ones are checked as all others.
    return _apply(settings, config.model_dump(mode="json"), Places(Place(None), {}))


def read_preset(preset: str) -> dict[str, Any]:
    """Reads what a preset sets, without the defaults of all other keys.

    Args:
        preset: one of :data:`PRESETS`.

    Returns:
        Plain values by section and key.

    Raises:
        ConfigError: there is no such preset.

    >>> sorted(read_preset("demo"))[:2]
    ['enet', 'evaluate']
    """
    if preset not in PRESETS:
        raise ConfigError(
            f"no preset is called {describe_value(preset)}",
            remedy=f"{did_you_mean(str(preset), PRESETS)}Known: {', '.join(PRESETS)}.",
        )
    file = _PRESET_FOLDER / f"{preset}.yaml"
    return read_yaml_mapping(file, "preset", "sections", "Install the package again.").values


def diff_from_preset(config: PipelineConfig, preset: str) -> dict[str, tuple[Any, Any]]:
    """Lists the values of a configuration that are not the preset's.

    Args:
        config: the effective configuration.
        preset: one of :data:`PRESETS`.

    Returns:
        (the preset's value, the effective value) by ``section.key``; ``None`` where one of them has no such key, since
        the section that would hold it is null there.

    Raises:
        ConfigError: there is no such preset.

    >>> diff_from_preset(load_configuration("demo", settings=["gnet.seed=5"]), "demo")
    {'gnet.seed': (0, 5)}
    """
    base = _flatten(validate_config(read_preset(preset), preset).model_dump(mode="json"))
    effective = _flatten(config.model_dump(mode="json"))
    # A section that is null has no keys of its own, so that either may have some that the other lacks.
    keys = dict.fromkeys((*base, *effective))
    return {key: (base.get(key), effective.get(key)) for key in keys if base.get(key) != effective.get(key)}


def _apply(settings: Sequence[str], values: Mapping[str, Any], places: Places) -> PipelineConfig:
    # A single text is a sequence of characters, which would be read as settings of one letter.
    if isinstance(settings, str):
        raise ConfigError(
            f"settings are a list, got {describe_value(settings)}", remedy="Write ['section.key=value', …]."
        )
    for setting in settings:
        path, value = parse_setting(setting)
        change: Mapping[str, Any] = value
        for key in reversed(path):
            change = {key: change}
        values = _merge(values, _expand_effects_word(change))
        # A setting stands in the error itself, so no file is named for it.
        places = places.replaced(path, Place(None))
    return validate_config(values, source="settings", places=places)


def _flatten(values: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    flat: dict[str, Any] = {}
    for key, value in values.items():
        if isinstance(value, Mapping):
            flat |= _flatten(value, f"{prefix}{key}.")
        else:
            flat[f"{prefix}{key}"] = value
    return flat


def _expand_effects_word(change: Mapping[str, Any]) -> Mapping[str, Any]:
    """Replaces ``effects``, if it is one word, by that word for each effect: none, off, on or auto.

    ``on`` is for the effects that are modelled; those that are only reported stay at auto.
    """
    word = change.get("effects")
    if not isinstance(word, str | bool):
        return change
    # Readers of YAML 1.1, such as Prefect's of deployments, take a bare on or off for a truth value.
    value = {"none": "off", True: "on", False: "off"}.get(word, word)
    effects = dict.fromkeys(EffectsConfig.model_fields, value)
    if value == "on":
        for name, field in EffectsConfig.model_fields.items():
            if field.annotation == Literal["auto", "off"]:
                effects[name] = "auto"
    return {**change, "effects": effects}


def _merge(base: Mapping[str, Any], change: Mapping[str, Any]) -> dict[str, Any]:
    merged = dict(base)
    for key, value in change.items():
        # Sections merge key by key. Lists do not: a user who sets shifts means these alone.
        are_sections = isinstance(value, Mapping) and isinstance(merged.get(key), Mapping)
        merged[key] = _merge(merged[key], value) if are_sections else value
    return merged
