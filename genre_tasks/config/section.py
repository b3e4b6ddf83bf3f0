"""What every section of the configuration shares, and the learning rates that several sections have."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Annotated

from pydantic import BaseModel, ConfigDict, Field

# 0 is allowed: it keeps an attribute as it is.
LearningRate = Annotated[float, Field(ge=0, allow_inf_nan=False)]
LearningRateTuple = tuple[float, float, float, float, float]
"""Learning rates of means, log-scales, quaternions, logit opacities and colours, in this order."""


class Section(BaseModel):
    """Base of all sections: unknown keys are errors, values are frozen."""

    # A mistyped key must not be ignored, and a stage must not change what its key was computed from.
    model_config = ConfigDict(extra="forbid", frozen=True)


class LearningRates(Section):
    """Learning rate of each attribute of a Gaussian.

    >>> LearningRates(means=0.1, log_scales=0.2, quats=0.05, logit_opacities=0.3, colors=0.02).as_tuple()
    (0.1, 0.2, 0.05, 0.3, 0.02)
    """

    means: LearningRate = Field(description="Of the centre, in units of the Gaussian's initial size.")
    log_scales: LearningRate = Field(description="Of the natural logarithm of the three scales.")
    quats: LearningRate = Field(description="Of the quaternion's components.")
    logit_opacities: LearningRate = Field(description="Of the opacity's logit.")
    colors: LearningRate = Field(description="Of the sRGB colour in [0, 1].")

    def as_tuple(self) -> LearningRateTuple:
        """Lists the learning rates.

        Returns:
            The five numbers in the order of a Gaussian's packed attributes.
        """
        return (self.means, self.log_scales, self.quats, self.logit_opacities, self.colors)

    @classmethod
    def from_sequence(cls, rates: Sequence[float]) -> LearningRates:
        """Inverts :meth:`as_tuple`.

        Args:
            rates: five learning rates.

        >>> LearningRates.from_sequence([0.1, 0.2, 0.05, 0.3, 0.02]).quats
        0.05
        """
        # ``strict`` refuses a list that is too short or too long.
        return cls(**dict(zip(cls.model_fields, rates, strict=True)))
