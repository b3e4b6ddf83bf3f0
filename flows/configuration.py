"""Presets, files and ``--set`` merged into one checked configuration; unknown keys answer with "did you mean"."""

from __future__ import annotations

import difflib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Literal, get_args

import yaml
from pydantic import BaseModel, ValidationError

from genre_tasks.config import EffectsConfig, PipelineConfig
from genre_tasks.errors import ConfigError

PRESETS = ("demo", "small", "fine", "long", "paper")
_FOLDER = Path(__file__).resolve().parent.parent / "configs"


def load_configuration(preset: str, file: Path | None = None, settings: Sequence[str] = ()) -> PipelineConfig:
    """The effective configuration: the preset, then ``file``, then each ``section.key=value`` of ``settings``.

    Raises ``ConfigError`` for an unknown preset, file, key (with the nearest known one) or a value out of range.
    """
    values = preset_values(preset)
    if file is not None:
        values = _merged(values, _spelled_out(_read_yaml(file)))
    for setting in settings:
        values = _merged(values, _spelled_out(_parse_setting(setting)))
    return validated(values, source=str(file or f"preset {preset}"))


def with_settings(config: PipelineConfig, settings: Sequence[str]) -> PipelineConfig:
    """``config`` with each ``section.key=value`` over it. Raises ``ConfigError`` as :func:`load_configuration`."""
    values: Mapping[str, Any] = config.model_dump(mode="json")
    for setting in settings:
        values = _merged(values, _spelled_out(_parse_setting(setting)))
    return validated(values, source="settings")


def preset_values(preset: str) -> dict[str, Any]:
    """What a preset says, as plain values."""
    if preset not in PRESETS:
        raise ConfigError(
            f"no preset is called '{preset}'", remedy=f"{_did_you_mean(preset, PRESETS)}Known: {', '.join(PRESETS)}."
        )
    values = _read_yaml(_FOLDER / f"{preset}.yaml")
    return values


def validated(values: Mapping[str, Any], source: str) -> PipelineConfig:
    """Checked values; all problems of the first unknown or wrong key are said at once."""
    _check_keys(values, PipelineConfig, "", source)
    try:
        return PipelineConfig.model_validate(values)
    except ValidationError as error:
        first = error.errors()[0]
        key = ".".join(str(p) for p in first["loc"])
        raise ConfigError(
            f"the value of {key} is not allowed: {first['msg']} (got {first['input']!r})",
            remedy="See `genre show config` for the keys, their values and their bounds.",
            file=source,
        ) from error


def differences(config: PipelineConfig, preset: str) -> dict[str, tuple[Any, Any]]:
    """``section.key`` → (value in the preset, effective value), where they differ."""
    base = validated(preset_values(preset), preset)
    left, right = _flat(base.model_dump(mode="json")), _flat(config.model_dump(mode="json"))
    return {key: (left[key], right[key]) for key in left if left[key] != right[key]}


def _flat(values: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    out: dict[str, Any] = {}
    for key, value in values.items():
        if isinstance(value, Mapping):
            out |= _flat(value, f"{prefix}{key}.")
        else:
            out[f"{prefix}{key}"] = value
    return out


def _read_yaml(path: Path) -> dict[str, Any]:
    try:
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
    key, equals, text = setting.partition("=")
    if not equals or not key:
        raise ConfigError(f"cannot read --set {setting!r}", remedy="Write --set section.key=value.")
    value: Any = yaml.safe_load(text) if text else None
    for part in reversed(key.strip().split(".")):
        value = {part: value}
    return value


def _spelled_out(change: Mapping[str, Any]) -> Mapping[str, Any]:
    """``effects`` given as one word becomes that word for each effect; none: off, on: of those modelled."""
    word = change.get("effects")
    if not isinstance(word, str | bool):
        return change
    value = {"none": "off", True: "on", False: "off"}.get(word, word)
    told = [name for name, field in EffectsConfig.model_fields.items() if field.annotation == Literal["auto", "off"]]
    each = dict.fromkeys(EffectsConfig.model_fields, value)
    return {**change, "effects": each | dict.fromkeys(told, "auto") if value == "on" else each}


def _merged(base: Mapping[str, Any], change: Mapping[str, Any]) -> dict[str, Any]:
    out = dict(base)
    for key, value in change.items():
        both = isinstance(value, Mapping) and isinstance(out.get(key), Mapping)
        out[key] = _merged(out[key], value) if both else value
    return out


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


def _check_keys(values: Mapping[str, Any], model: type[BaseModel], prefix: str, source: str) -> None:
    for key, value in values.items():
        if f"{prefix}{key}" in RENAMED_KEYS:
            raise ConfigError(
                f"the configuration key '{prefix}{key}' was renamed",
                remedy=f"Write '{RENAMED_KEYS[prefix + key]}'.",
                file=source,
            )
        if f"{prefix}{key}" in REMOVED_KEYS:
            raise ConfigError(
                f"the configuration key '{prefix}{key}' was removed", remedy=REMOVED_KEYS[prefix + key], file=source
            )
        if key not in model.model_fields:
            raise ConfigError(
                f"there is no configuration key '{prefix}{key}'",
                remedy=f"{_did_you_mean(key, model.model_fields, prefix)}Known here: {', '.join(model.model_fields)}.",
                file=source,
            )
        annotation, optional = _section_type(model.model_fields[key].annotation)
        if annotation is not None and not (optional and value is None):
            if not isinstance(value, Mapping):
                raise ConfigError(
                    f"'{prefix}{key}' is a section, got {value!r}",
                    remedy=f"Write e.g. --set {prefix}{key}.{next(iter(annotation.model_fields))}=….",
                    file=source,
                )
            _check_keys(value, annotation, f"{prefix}{key}.", source)


def _section_type(annotation: Any) -> tuple[type[BaseModel] | None, bool]:
    """The section's model if a field's annotation is one, and whether the field may be null instead."""
    kinds = get_args(annotation) or (annotation,)
    for kind in kinds:
        if isinstance(kind, type) and issubclass(kind, BaseModel):
            return kind, type(None) in kinds
    return None, False


def _did_you_mean(word: str, known: Any, prefix: str = "") -> str:
    near = difflib.get_close_matches(word, list(known), n=1, cutoff=0.5)
    return f"Did you mean '{prefix}{near[0]}'? " if near else ""
