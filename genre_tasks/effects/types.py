"""What an effect measures, and what follows from it."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Literal

import numpy as np
from numpy.typing import NDArray

from genre_tasks.logs.types import MotionBlur, RollingShutter

if TYPE_CHECKING:
    from genre_tasks.effects.measurements import Seen

BASIC = frozenset({"rigid_actors", "distant_region", "lidar_depth"})
"""What a scene has that was not planned for."""

Setting = Literal["auto", "on", "off"]
Choice = Literal["on", "off", "mark"]


@dataclass(frozen=True)
class Measured:
    """A property of the log: ``value`` in the effect's unit, ``None`` where the log does not tell; a sentence on it."""

    value: float | None
    said: str


@dataclass(frozen=True)
class Fitted:
    """What applying an effect needs to know of the chunk's images, beside the log itself.

    ``gains``: by camera and frame, the log of an image's gain in linear light, red, green and blue, of mean zero over
    source images. ``own``: by camera, where the vehicle itself is in the image, [H, W]. ``shutters``: by camera and
    frame, how the camera moves while the image is read out; ``blurs``: while it is exposed.
    """

    gains: Mapping[tuple[str, int], tuple[float, float, float]] = field(default_factory=dict)
    own: Mapping[str, NDArray[np.bool_]] = field(default_factory=dict)
    shutters: Mapping[tuple[str, int], RollingShutter] = field(default_factory=dict)
    blurs: Mapping[tuple[str, int], MotionBlur] = field(default_factory=dict)

    def with_those_of(self, other: Fitted) -> Fitted:
        """Both."""
        gains, own = {**self.gains, **other.gains}, {**self.own, **other.own}
        return Fitted(gains, own, {**self.shutters, **other.shutters}, {**self.blurs, **other.blurs})


@dataclass(frozen=True)
class Effect:
    """An effect: the property that decides, its unit and threshold (called for above it), and what enabling costs.

    ``needs`` says what a log must state for the effect to be possible at all: ``None`` where nothing is missing.
    ``marks``: it is told, not modelled. ``fit`` is what applying it needs to know, asked where it is on.
    """

    name: str
    property: str
    unit: str
    threshold: float
    cost: str
    measure: Callable[[Seen], Measured]
    needs: Callable[[Seen], str | None] = lambda _: None
    marks: bool = False
    fit: Callable[[Seen], Fitted] = lambda _: Fitted()


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
    """The decisions for one chunk, in the order of ``plan.EFFECTS``, and what applying those that are on needs.

    Without any decision it is the plan of a scene that was not planned for: ``BASIC``.
    """

    decisions: tuple[Decision, ...] = ()
    fitted: Fitted = Fitted()

    def on(self, name: str) -> bool:
        """Whether the effect is modelled."""
        return any(d.name == name and d.choice == "on" for d in self.decisions) if self.decisions else name in BASIC

    def __getitem__(self, name: str) -> Decision:
        return {d.name: d for d in self.decisions}[name]


UNPLANNED = EffectsPlan()
