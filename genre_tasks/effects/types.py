"""What an effect measures, and what follows from it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

from genre_tasks.effects.seen import Seen

Setting = Literal["auto", "on", "off"]
Choice = Literal["on", "off", "mark"]


@dataclass(frozen=True)
class Measured:
    """A property of the log: ``value`` in the effect's unit, ``None`` where the log does not tell; a sentence on it."""

    value: float | None
    said: str


@dataclass(frozen=True)
class Effect:
    """An effect: the property that decides, its unit and threshold (called for above it), and what enabling costs.

    ``needs`` says what a log must state for the effect to be possible at all: ``None`` where nothing is missing.
    ``marks``: it is told, not modelled.
    """

    name: str
    property: str
    unit: str
    threshold: float
    cost: str
    measure: Callable[[Seen], Measured]
    needs: Callable[[Seen], str | None] = lambda _: None
    marks: bool = False


@dataclass(frozen=True)
class Decision:
    """One row of a plan. ``value`` is NaN where the log does not tell, or where nothing had to be measured."""

    name: str
    property: str
    value: float
    unit: str
    threshold: float
    setting: Setting
    choice: Choice
    reason: str
    cost: str


@dataclass(frozen=True)
class EffectsPlan:
    """The decisions for one chunk, in the order of ``plan.EFFECTS``."""

    decisions: tuple[Decision, ...]

    def __getitem__(self, name: str) -> Decision:
        return {d.name: d for d in self.decisions}[name]
