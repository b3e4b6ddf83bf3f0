"""What every section of the configuration shares: strict values, and the types of values that several sections have."""

from __future__ import annotations

import os
import unicodedata
from collections.abc import Sequence
from typing import Annotated, Self, TypeVar

from pydantic import AfterValidator, BaseModel, ConfigDict, Field, model_validator

Item = TypeVar("Item")

# 0 is allowed: it keeps an attribute as it is. Above 100 a single step would leave the range of float32 for log-scales.
LearningRate = Annotated[float, Field(ge=0, le=100)]
LearningRateTuple = tuple[float, float, float, float, float]
"""Learning rates of means, log-scales, quaternions, logit opacities and colours, in this order."""

# The losses are summed in float32: larger weights would overflow to infinity.
LossWeight = Annotated[float, Field(ge=0, le=1e6)]
"""Weight of a term of a loss."""

Seed = Annotated[int, Field(ge=0, le=1_000_000_000)]
"""Seed of random choices; stages add small numbers to it, and the sum has to fit into 32 bits."""


def _check_characters(text: str) -> str:
    # It is written into manifests as UTF-8 and given to the system as a path: neither takes such characters.
    stray = [character for character in text if unicodedata.category(character) in ("Cc", "Cs")]
    if stray:
        raise ValueError(f"it has the character U+{ord(stray[0]):04X}, which text of one line cannot have")
    return text


def _refuse_duplicates(values: tuple[Item, ...]) -> tuple[Item, ...]:
    # Compared as they are written, since results are named by what is written: 3 and 3.0000001 are both "3".
    written = [f"{value:g}" if isinstance(value, float) else str(value) for value in values]
    for index, text in enumerate(written):
        if text in written[:index]:
            raise ValueError(f"{text} is listed twice")
    return values


Text = Annotated[str, Field(min_length=1), AfterValidator(_check_characters)]
"""Text of one line, at least one character."""

FilePath = Annotated[Text, AfterValidator(os.path.expanduser)]
"""Path of a file; a leading ``~`` is the user's home folder."""

# Lists come from YAML and JSON, where tuples do not exist: only here is another type taken than the declared one.
TextList = Annotated[tuple[Text, ...], Field(strict=False, min_length=1), AfterValidator(_refuse_duplicates)]
"""Different words, at least one."""

# A scene ends long before 100 m beside the path.
Shifts = Annotated[
    tuple[Annotated[float, Field(ge=-100, le=100)], ...], Field(strict=False), AfterValidator(_refuse_duplicates)
]
"""Different distances beside the path in metres, positive to the left."""

Distances = Annotated[
    tuple[Annotated[float, Field(gt=0, le=100)], ...], Field(strict=False), AfterValidator(_refuse_duplicates)
]
"""Different distances beside the path in metres, on both sides."""


class Section(BaseModel):
    """Base of all sections: unknown keys are errors, values have exactly their type, are finite and stay as they are.

    >>> Section.model_config["strict"]
    True
    """

    # A mistyped key must not be ignored, and a stage must not change what its key was computed from. Without strict,
    # true would be the number 1 and "3" the number 3. JSON has no number for infinity or NaN, and no stage can use one.
    model_config = ConfigDict(extra="forbid", frozen=True, strict=True, allow_inf_nan=False)


class FilePlacement(Section):
    """How coordinates of a file become the log's world: turned, then scaled, about the origin that both share.

    >>> FilePlacement().quat
    (1.0, 0.0, 0.0, 0.0)
    """

    scale: float = Field(1.0, ge=1e-6, le=1e6, description="Metres a unit of the file.")
    quat: Annotated[tuple[float, float, float, float], Field(strict=False)] = Field(
        (1.0, 0.0, 0.0, 0.0), description="Rotation from the file's axes to the world's as w, x, y, z."
    )

    @model_validator(mode="after")
    def _require_rotation(self) -> Self:
        # No length to divide by, or one that overflows.
        if not 1e-6 < sum(value * value for value in self.quat) < 1e6:
            raise ValueError("quat is no rotation")
        return self


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
