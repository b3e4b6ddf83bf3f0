"""Types of the effects' plan: what an effect measures, what a plan decides, and what applying the plan needs."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Literal

import numpy as np
from numpy.typing import NDArray

from genre_tasks.logs.types import Float64, MotionBlur, RollingShutter
from genre_tasks.scene.chunk import Points

if TYPE_CHECKING:
    from genre_tasks.effects.measurements import ChunkMeasurements

# These are what the paper's scene graph and loss have: actors, a distant shell, a depth term (Sec. III-A, Eq. 9).
DEFAULT_EFFECTS = frozenset({"rigid_actors", "distant_region", "lidar_depth"})
"""The effects of a scene that was reconstructed without a plan."""

ImageKey = tuple[str, int]
"""Name of a camera and frame of the log."""

Setting = Literal["auto", "on", "off"]
"""What the configuration says of an effect; ``auto`` leaves the decision to the measured property."""

Choice = Literal["on", "off", "mark"]
"""What the plan decides; ``mark`` reports an effect that is not modelled."""


@dataclass(frozen=True)
class Measurement:
    """The measured property of a log that decides on an effect.

    Attributes:
        value: the property in the effect's unit; ``None`` where the log does not allow to measure it.
        explanation: a phrase for the plan's reason, such as which camera the value is of.
    """

    value: float | None
    explanation: str


@dataclass(frozen=True)
class EffectParameters:
    """What applying the effects of a plan needs to know of each image, in addition to the log itself.

    Attributes:
        gains: natural logarithm of an image's gain in linear light, for red, green and blue. Its mean over the source
            images that share points with others is zero.
        ego_masks: by camera, [H, W], true where the recording vehicle itself is in the image.
        shutters: how the camera moves while the rows of an image are read out.
        blurs: how the camera moves while an image is exposed.
        stereo_points: of the background, where LiDAR has none; ``None``: there are none.
        poses: [4, 4] refined chunk_SE3_camera of an image.
        ego_points: rows of the background's points that took their colour from the recording vehicle itself.
    """

    gains: Mapping[ImageKey, tuple[float, float, float]] = field(default_factory=dict)
    ego_masks: Mapping[str, NDArray[np.bool_]] = field(default_factory=dict)
    shutters: Mapping[ImageKey, RollingShutter] = field(default_factory=dict)
    blurs: Mapping[ImageKey, MotionBlur] = field(default_factory=dict)
    stereo_points: Points | None = None
    poses: Mapping[ImageKey, Float64] = field(default_factory=dict)
    ego_points: NDArray[np.int64] | None = None

    def merge(self, other: EffectParameters) -> EffectParameters:
        """Combines the parameters of two effects.

        Args:
            other: parameters of another effect; they win where both have an entry.

        Returns:
            The parameters of both.

        >>> exposure = EffectParameters(gains={("front", 0): (0.1, 0.0, -0.1)})
        >>> mask = EffectParameters(ego_masks={"front": np.ones((2, 2), bool)})
        >>> both = exposure.merge(mask)
        >>> list(both.gains), list(both.ego_masks)
        ([('front', 0)], ['front'])
        """
        return EffectParameters(
            gains={**self.gains, **other.gains},
            ego_masks={**self.ego_masks, **other.ego_masks},
            shutters={**self.shutters, **other.shutters},
            blurs={**self.blurs, **other.blurs},
            stereo_points=self.stereo_points if other.stereo_points is None else other.stereo_points,
            poses={**self.poses, **other.poses},
            ego_points=self.ego_points if other.ego_points is None else other.ego_points,
        )


@dataclass(frozen=True)
class Effect:
    """An effect of the forward model: the property of a log that decides on it, and what enabling it costs.

    Attributes:
        name: name in the configuration and in the plan; also that of the effect's module.
        property: the property that is measured, in words.
        unit: unit of the property and of the threshold.
        threshold: the effect is enabled where the property is larger.
        cost: what enabling it costs, in words.
        measure: measures the property on a chunk.
        find_missing: names what the log lacks for the effect to be possible; ``None`` if it is possible.
        report_only: the effect is reported, and not modelled.
        fit: estimates what applying the effect needs to know; called where the effect is on.
        requires: an effect that is decided before it, and without which it does nothing; ``None``: it needs no other.
    """

    name: str
    property: str
    unit: str
    threshold: float
    cost: str
    measure: Callable[[ChunkMeasurements], Measurement]
    # Most effects ask nothing of a log, and need nothing to be applied.
    find_missing: Callable[[ChunkMeasurements], str | None] = lambda _: None
    report_only: bool = False
    fit: Callable[[ChunkMeasurements], EffectParameters] = lambda _: EffectParameters()
    requires: str | None = None


@dataclass(frozen=True)
class Decision:
    """One row of a plan: the decision on one effect, and why.

    Attributes:
        name: name of the effect.
        property: the property that decides; empty where nothing was measured.
        value: the measured property; NaN where it was not or could not be measured.
        unit: unit of ``value`` and ``threshold``.
        threshold: the effect is called for above it; NaN where nothing was measured.
        setting: what the configuration says.
        choice: what the plan decides.
        reason: why, for the reader of a report.
        cost: what enabling the effect costs.
    """

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
    """The decisions for one chunk, and the parameters of the effects that are on.

    A plan without any decision stands for a scene that was not planned for: it has the ``DEFAULT_EFFECTS``.

    Attributes:
        decisions: one for each effect, in the order of the configuration.
        parameters: what applying the effects that are on needs.

    >>> EffectsPlan().is_on("lidar_depth"), EffectsPlan().is_on("exposure")
    (True, False)
    """

    decisions: tuple[Decision, ...] = ()
    # The default is shared by all plans; its mappings are never written to.
    parameters: EffectParameters = EffectParameters()

    def is_on(self, name: str) -> bool:
        """Tells whether an effect is modelled.

        Args:
            name: name of the effect.

        Returns:
            Whether the plan turns it on; an effect that is only reported is not on.
        """
        if not self.decisions:
            return name in DEFAULT_EFFECTS
        # An effect that is only reported has the choice ``mark``, which is not on.
        return any(decision.name == name and decision.choice == "on" for decision in self.decisions)

    def __getitem__(self, name: str) -> Decision:
        return {decision.name: decision for decision in self.decisions}[name]


DEFAULT_PLAN = EffectsPlan()
"""The plan of a scene that was not planned for."""
