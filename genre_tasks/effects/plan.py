"""The plan of a chunk's effects: what each measures, the threshold, the decision, and why."""

from __future__ import annotations

import math
from collections.abc import Sequence
from importlib import import_module

from genre_tasks.config import EffectsConfig
from genre_tasks.effects.measurements import Seen
from genre_tasks.effects.types import Choice, Decision, Effect, EffectsPlan, Fitted, Measured
from genre_tasks.errors import ConfigError
from genre_tasks.logs.types import Camera
from genre_tasks.progress import Progress, silent
from genre_tasks.scene.chunk import Chunk

EFFECTS = tuple(EffectsConfig.model_fields)
"""Names, in the order of a plan: that of the configuration. Each is a module of this package with an ``EFFECT``."""


def effect_of(name: str) -> Effect:
    """The effect; its module is imported when it is asked for."""
    found: Effect = import_module(f"genre_tasks.effects.{name}").EFFECT
    return found


def plan(config: EffectsConfig, chunk: Chunk, cameras: Sequence[Camera], progress: Progress = silent) -> EffectsPlan:
    """Asks each effect that is not set off. Raises ``ConfigError`` for one set on that the log makes impossible."""
    seen, rows, fitted = Seen(chunk, cameras), [], Fitted()
    for k, name in enumerate(EFFECTS):
        progress(k, len(EFFECTS), name)
        rows.append(_decided(name, getattr(config, name), seen))
        if rows[-1].choice == "on":
            fitted = fitted.with_those_of(effect_of(name).fit(seen))
    progress(len(EFFECTS), len(EFFECTS), "effects")
    return EffectsPlan(tuple(rows), fitted)


def _decided(name: str, setting: str, seen: Seen) -> Decision:
    if setting == "off":
        return Decision(name, "", math.nan, "", math.nan, "off", "off", "set off: not measured", "")
    effect = effect_of(name)
    missing = effect.needs(seen)
    if setting == "on" and missing is not None:
        raise ConfigError(
            f"the effect {name} is set on, and {missing}",
            remedy=f"Set effects.{name} to auto or off, or give the log what it lacks.",
            log=seen.chunk.log,
            chunk=seen.chunk.index,
        )
    found = Measured(None, missing) if missing is not None else effect.measure(seen)
    choice, reason = _choice(effect, found, setting)
    value = math.nan if found.value is None else found.value
    return Decision(
        name,
        effect.property,
        value,
        effect.unit,
        effect.threshold,
        "on" if setting == "on" else "auto",
        choice,
        reason,
        effect.cost,
    )


def _choice(effect: Effect, found: Measured, setting: str) -> tuple[Choice, str]:
    called: Choice = "mark" if effect.marks else "on"
    told = found.value is not None and math.isfinite(found.value)
    if setting == "on":
        return called, f"set on; {f'{found.value:.3g} {effect.unit}: ' if told else ''}{found.said}"
    if not told:
        return "off", found.said
    above = found.value is not None and found.value > effect.threshold
    said = f"{found.value:.3g} is {'above' if above else 'not above'} {effect.threshold:g} {effect.unit}: {found.said}"
    return called if above else "off", said
