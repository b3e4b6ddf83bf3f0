"""Presets, files and ``--set`` merged into one checked configuration; unknown keys answer with "did you mean"."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Literal, get_args

import yaml
from pydantic import BaseModel, ValidationError

from genre_tasks.config import EffectsConfig, PipelineConfig
from genre_tasks.errors import ConfigError
from genre_tasks.suggestions import did_you_mean

PRESETS = ("demo", "small", "fine", "long", "paper")
_PRESET_FOLDER = Path(__file__).resolve().parent.parent / "configs"

# An old key is an error and not an alias: with aliases every key would keep two names for good.
RENAMED_KEYS = {
    "ingest.walls": "ingest.complete_facades",
    "gnet.finish": "gnet.refine",
    "gnet.refine.share": "gnet.refine.fraction_of_iterations",
    "gnet.refine.split": "gnet.refine.split_fraction",
    "gnet.refine.rates_before": "gnet.refine.lr_before_refine",
    "gnet.per_scene.means_rate": "gnet.per_scene.means_lr",
    "gnet.per_scene.means_rate_end": "gnet.per_scene.means_lr_end_fraction",
    "gnet.per_scene.log_scales_rate": "gnet.per_scene.log_scales_lr",
    "gnet.per_scene.quats_rate": "gnet.per_scene.quats_lr",
    "gnet.per_scene.logit_opacities_rate": "gnet.per_scene.logit_opacities_lr",
    "gnet.per_scene.sh_rate": "gnet.per_scene.sh_lr",
    **{
        f"{section}.{old}": f"{section}.{new}"
        for section in ("gnet", "enet")
        for old, new in (
            ("rates", "learning_rates"),
            ("adam.rates", "adam.learning_rates"),
            ("hold_ground", "constrain_ground"),
            ("split", "split_fraction"),
        )
    },
}
"""Keys of version 0.1 and what they are called since; an old key is an error that names the new one."""

REMOVED_KEYS = {
    "effects.fixer_per_view": "It changed nothing; fnet.gate decides which views are fixed.",
    "training": "Training commands read their own recipes; delete the section.",
}
"""Keys of version 0.1 that are gone, and what to do instead."""


def load_configuration(preset: str, file: Path | None = None, settings: Sequence[str] = ()) -> PipelineConfig:
    """Merges a preset, a file and single settings into the configuration of a run; later ones win.

    Args:
        preset: one of :data:`PRESETS`.
        file: a YAML file with sections as in ``configs/``; ``None`` for none.
        settings: ``section.key=value`` strings; values are YAML, such as ``[1, 2]`` or ``null``.

    Returns:
        The checked configuration.

    Raises:
        ConfigError: a preset, file or key does not exist (the nearest one is named), or a value is not allowed.

    >>> load_configuration("demo", settings=["gnet.iterations=8"]).gnet.iterations
    8
    """
    values = read_preset(preset)
    if file is not None:
        values = _merge(values, _expand_effects_word(_read_yaml(file)))
    for setting in settings:
        values = _merge(values, _expand_effects_word(_parse_setting(setting)))
    return validate_config(values, source=str(file or f"preset {preset}"))


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
    values: Mapping[str, Any] = config.model_dump(mode="json")
    for setting in settings:
        values = _merge(values, _expand_effects_word(_parse_setting(setting)))
    return validate_config(values, source="settings")


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
            f"no preset is called '{preset}'", remedy=f"{did_you_mean(preset, PRESETS)}Known: {', '.join(PRESETS)}."
        )
    return _read_yaml(_PRESET_FOLDER / f"{preset}.yaml")


def validate_config(values: Mapping[str, Any], source: str) -> PipelineConfig:
    """Checks plain values: first the keys, so that a mistyped one is answered with the nearest, then the values.

    Args:
        values: plain values by section and key; keys that are left out keep their defaults.
        source: where the values come from, for the error.

    Returns:
        The checked configuration.

    Raises:
        ConfigError: a key does not exist, was renamed or removed, or a value is not allowed.

    >>> validate_config({"gnet": {"iteration": 8}}, "the example")
    Traceback (most recent call last):
    genre_tasks.errors.ConfigError: there is no configuration key 'gnet.iteration' (file the example). Did you mean …
    """
    # Before pydantic sees the values: its own message about an unknown key has no suggestion.
    _check_keys(values, PipelineConfig, "", source)
    try:
        return PipelineConfig.model_validate(values)
    except ValidationError as error:
        # One at a time: further problems are often consequences of the first.
        first = error.errors()[0]
        key = ".".join(str(part) for part in first["loc"])
        raise ConfigError(
            f"the value of {key} is not allowed: {first['msg']} (got {first['input']!r})",
            remedy="See `genre show config` for the keys, their values and their bounds.",
            file=source,
        ) from error


def diff_from_preset(config: PipelineConfig, preset: str) -> dict[str, tuple[Any, Any]]:
    """Lists the values of a configuration that are not the preset's.

    Args:
        config: the effective configuration.
        preset: one of :data:`PRESETS`.

    Returns:
        (the preset's value, the effective value) by ``section.key``.

    Raises:
        ConfigError: there is no such preset.

    >>> diff_from_preset(load_configuration("demo", settings=["gnet.seed=5"]), "demo")
    {'gnet.seed': (0, 5)}
    """
    base = _flatten(validate_config(read_preset(preset), preset).model_dump(mode="json"))
    effective = _flatten(config.model_dump(mode="json"))
    return {key: (base[key], effective[key]) for key in base if base[key] != effective[key]}


def _flatten(values: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    flat: dict[str, Any] = {}
    for key, value in values.items():
        if isinstance(value, Mapping):
            flat |= _flatten(value, f"{prefix}{key}.")
        else:
            flat[f"{prefix}{key}"] = value
    return flat


def _read_yaml(path: Path) -> dict[str, Any]:
    try:
        # An empty file is no mistake: it changes nothing.
        values = yaml.safe_load(path.read_text(encoding="utf-8")) or {}
    except FileNotFoundError as error:
        raise ConfigError(
            "no such configuration file", remedy="Check the path given to --config.", file=path
        ) from error
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        raise ConfigError(f"the file is not YAML: {error}", remedy="Mend the line it names.", file=path) from error
    if not isinstance(values, dict):
        raise ConfigError("expected sections at the top level", remedy="Write e.g. 'gnet: {iterations: 8}'.", file=path)
    return values


def _parse_setting(setting: str) -> dict[str, Any]:
    """``gnet.iterations=8`` as ``{"gnet": {"iterations": 8}}``."""
    key, equals, text = setting.partition("=")
    if not equals or not key:
        raise ConfigError(f"cannot read --set {setting!r}", remedy="Write --set section.key=value.")
    # Read as YAML, so that --set and files understand numbers, lists and null alike.
    value: Any = yaml.safe_load(text) if text else None
    for part in reversed(key.strip().split(".")):
        value = {part: value}
    return value


def _expand_effects_word(change: Mapping[str, Any]) -> Mapping[str, Any]:
    """Replaces ``effects``, if it is one word, by that word for each effect: none, off, on or auto.

    ``on`` is for the effects that are modelled; those that are only reported stay at auto.
    """
    word = change.get("effects")
    if not isinstance(word, str | bool):
        return change
    # YAML reads a bare on or off as a truth value.
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


def _check_keys(values: Mapping[str, Any], model: type[BaseModel], prefix: str, source: str) -> None:
    for key, value in values.items():
        _check_key(key, model, prefix, source)
        section, is_optional = _section_type(model.model_fields[key].annotation)
        if section is None or (is_optional and value is None):
            continue
        if not isinstance(value, Mapping):
            raise ConfigError(
                f"'{prefix}{key}' is a section, got {value!r}",
                remedy=f"Write e.g. --set {prefix}{key}.{next(iter(section.model_fields))}=….",
                file=source,
            )
        _check_keys(value, section, f"{prefix}{key}.", source)


def _check_key(key: str, model: type[BaseModel], prefix: str, source: str) -> None:
    full_key = f"{prefix}{key}"
    if full_key in RENAMED_KEYS:
        raise ConfigError(
            f"the configuration key '{full_key}' was renamed", remedy=f"Write '{RENAMED_KEYS[full_key]}'.", file=source
        )
    if full_key in REMOVED_KEYS:
        raise ConfigError(f"the configuration key '{full_key}' was removed", remedy=REMOVED_KEYS[full_key], file=source)
    if key not in model.model_fields:
        raise ConfigError(
            f"there is no configuration key '{full_key}'",
            remedy=f"{did_you_mean(key, model.model_fields, prefix)}Known here: {', '.join(model.model_fields)}.",
            file=source,
        )


def _section_type(annotation: Any) -> tuple[type[BaseModel] | None, bool]:
    """The section's model if a field's annotation is one, and whether the field may be null instead."""
    # A field may be a section or null, as gnet.refine is: then the annotation is a union of both.
    kinds = get_args(annotation) or (annotation,)
    for kind in kinds:
        if isinstance(kind, type) and issubclass(kind, BaseModel):
            return kind, type(None) in kinds
    return None, False
