"""The plan of a chunk's effects: for each effect what was measured, the threshold, the decision, and the reason."""

from __future__ import annotations

import math
from collections.abc import Sequence
from importlib import import_module

from genre_tasks.config import EffectsConfig
from genre_tasks.effects.apply_plan import move_views
from genre_tasks.effects.measurements import ChunkMeasurements
from genre_tasks.effects.types import Choice, Decision, Effect, EffectParameters, EffectsPlan, Measurement
from genre_tasks.errors import ConfigError
from genre_tasks.logs.types import Camera
from genre_tasks.progress import Progress, silent
from genre_tasks.scene.chunk import Chunk

# The configuration is the only list of effects: a new one takes a field there and a module here.
EFFECT_NAMES = tuple(EffectsConfig.model_fields)
"""All effects, in the order of the configuration and of a plan. Each is a module of this package with an ``EFFECT``."""


def load_effect(name: str) -> Effect:
    """Imports the module of an effect, only when it is asked for, and returns its ``EFFECT``.

    Args:
        name: one of ``EFFECT_NAMES``.

    >>> load_effect("darkness").report_only
    True
    """
    # The module of an effect that is off is never imported, so that it can neither slow down nor break a run.
    effect: Effect = import_module(f"genre_tasks.effects.{name}").EFFECT
    return effect


def plan_effects(
    config: EffectsConfig, chunk: Chunk, cameras: Sequence[Camera], progress: Progress = silent
) -> EffectsPlan:
    """Decides on each effect of the forward model by measuring what of a chunk calls for it.

    An effect that the configuration turns off is neither measured nor imported.

    Args:
        config: on, off or auto for each effect.
        chunk: the chunk that the plan is for.
        cameras: the log's cameras, with the readout and exposure times that the log states.
        progress: called with the number of effects done, their total and the name of the next one.

    Returns:
        One decision for each effect, and the parameters of those that are on.

    Raises:
        ConfigError: an effect is set on that the log makes impossible.
    """
    # Measurements are shared: two effects that look at the same images decode them once.
    measurements = ChunkMeasurements(chunk, cameras)
    decisions: list[Decision] = []
    parameters = EffectParameters()
    for k, name in enumerate(EFFECT_NAMES):
        progress(k, len(EFFECT_NAMES), name)
        decision = _decide(name, getattr(config, name), measurements, decisions)
        decisions.append(decision)
        # An effect that is only reported has nothing to apply.
        if decision.choice == "on":
            fitted = load_effect(name).fit(measurements)
            parameters = parameters.merge(fitted)
            # Effects after one that moves views are measured at the poses that later stages have.
            if fitted.poses:
                measurements = ChunkMeasurements(move_views(chunk, fitted.poses), cameras, ingested=chunk)
    progress(len(EFFECT_NAMES), len(EFFECT_NAMES), "effects")
    return EffectsPlan(tuple(decisions), parameters)


def _decide(name: str, setting: str, measurements: ChunkMeasurements, decisions: Sequence[Decision]) -> Decision:
    # Measuring can take seconds: an effect that is turned off costs nothing.
    if setting == "off":
        return Decision(
            name=name,
            property="",
            value=math.nan,
            unit="",
            threshold=math.nan,
            setting="off",
            choice="off",
            reason="set off: not measured",
            cost="",
        )
    effect = load_effect(name)
    missing = effect.find_missing(measurements)
    # An error and not a silent off: without the effect the result would not be what the user asked for.
    if setting == "on" and missing is not None:
        raise ConfigError(
            f"the effect {name} is set on, and {missing}",
            remedy=f"Set effects.{name} to auto or off, or give the log what it lacks.",
            log=measurements.chunk.log,
            chunk=measurements.chunk.index,
        )
    measurement = effect.measure(measurements) if missing is None else Measurement(None, missing)
    choice, reason = _choose(effect, measurement, setting)
    unmet = _find_unmet(effect, decisions)
    # Where nothing calls for the effect, nothing is missed without the other one.
    if unmet is not None and choice == "on" and measurement.value:
        choice, reason = "off", f"{unmet}; {reason}"
    return Decision(
        name=name,
        property=effect.property,
        value=math.nan if measurement.value is None else measurement.value,
        unit=effect.unit,
        threshold=effect.threshold,
        setting="on" if setting == "on" else "auto",
        choice=choice,
        reason=reason,
        cost=effect.cost,
    )


def _find_unmet(effect: Effect, decisions: Sequence[Decision]) -> str | None:
    """Names the effect that another one needs where it is not on; ``None`` where nothing is missing."""
    is_on = any(decision.name == effect.requires and decision.choice == "on" for decision in decisions)
    return None if effect.requires is None or is_on else f"{effect.requires}, which it needs, is off"


def _choose(effect: Effect, measurement: Measurement, setting: str) -> tuple[Choice, str]:
    """Returns the decision on a measured effect, and its reason."""
    enabled: Choice = "mark" if effect.report_only else "on"
    value = measurement.value
    measured = value is not None and math.isfinite(value)
    explanation = measurement.explanation
    if setting == "on":
        # The value is reported even so, because it tells whether the setting is worthwhile.
        amount = f"{value:.3g} {effect.unit}: " if measured else ""
        return enabled, f"set on; {amount}{explanation}"
    # Without a value there is no comparison that the reason could name.
    if value is None or not measured:
        return "off", explanation
    above = value > effect.threshold
    comparison = "above" if above else "not above"
    reason = f"{value:.3g} is {comparison} {effect.threshold:g} {effect.unit}: {explanation}"
    return (enabled if above else "off"), reason
