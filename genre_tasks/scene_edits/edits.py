"""Edits of a run's traffic as a small declarative list, and how several edits of one actor become one."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from fractions import Fraction
from typing import Annotated, Literal

from pydantic import Field

from genre_tasks.config.section import Section, Text

Actor = Annotated[Text, Field(description="Readable name, number, track id, or the unique start of a name.")]
Metres = Annotated[float, Field(ge=-1000, le=1000)]
Degrees = Annotated[float, Field(ge=-3600, le=3600)]
Seconds = Annotated[float, Field(ge=-3600, le=3600)]


class Remove(Section):
    """Takes an actor out of the scene."""

    kind: Literal["remove"] = "remove"
    actor: Actor


class Insert(Section):
    """Puts an actor of this run or of another one into the scene, on the path that the ego vehicle recorded."""

    kind: Literal["insert"] = "insert"
    actor: Actor
    from_run: Text | None = Field(None, description="Run that the actor is taken from; null: the edited run itself.")
    name: Text | None = Field(None, description="Name of the new actor; null: made from the actor's readable name.")
    ahead_m: Metres = Field(10.0, description="Metres along the recorded path from the ego vehicle at the start.")
    left_m: Metres = Field(0.0, description="Metres to the left of the recorded path; negative is to the right.")
    turn_deg: Degrees = Field(0.0, description="Turn to the left against the path; at 180 the actor is oncoming.")
    speed_m_s: float | None = Field(
        None, ge=0, le=200, description="Speed in the direction that it faces, m/s; null: its mean recorded speed."
    )
    start_s: float = Field(0.0, ge=0, le=3600, description="Seconds after the first frame at which it appears.")


class Move(Section):
    """Shifts an actor along its axes, at every moment in those that it has then; it stays on the ground."""

    kind: Literal["move"] = "move"
    actor: Actor
    forward_m: Metres = Field(0.0, description="Metres in the direction that the actor faces in the recording.")
    left_m: Metres = Field(0.0, description="Metres to its left.")
    up_m: Metres = Field(0.0, description="Metres above where it would touch the ground as recorded.")


class Retime(Section):
    """Lets an actor drive its path later, or earlier."""

    kind: Literal["retime"] = "retime"
    actor: Actor
    delay_s: Seconds = Field(description="Seconds; negative is earlier.")


class Rotate(Section):
    """Turns an actor about its vertical axis; where it drives stays the same."""

    kind: Literal["rotate"] = "rotate"
    actor: Actor
    degrees: Degrees = Field(description="Degrees to the left.")


class ScaleSpeed(Section):
    """Lets an actor drive its path faster or slower, from where it is first."""

    kind: Literal["scale_speed"] = "scale_speed"
    actor: Actor
    factor: float = Field(ge=0, le=10, description="Of its speed at every moment; 0: it stands.")


Edit = Annotated[Remove | Insert | Move | Retime | Rotate | ScaleSpeed, Field(discriminator="kind")]
ChangeOfActor = Remove | Move | Retime | Rotate | ScaleSpeed

EDIT_KINDS: dict[str, type[Section]] = {
    "remove": Remove,
    "insert": Insert,
    "move": Move,
    "retime": Retime,
    "rotate": Rotate,
    "scale_speed": ScaleSpeed,
}


class EditList(Section):
    """Edits of one run, in the order in which they were written; part of the key of what is made with them.

    >>> len(EditList(edits=(Remove(actor="car-3"), Move(actor="car-4", left_m=1.0))))
    2
    """

    edits: Annotated[tuple[Edit, ...], Field(strict=False)] = ()

    def __len__(self) -> int:
        return len(self.edits)

    def __add__(self, other: EditList) -> EditList:
        return EditList(edits=self.edits + other.edits)


@dataclass(frozen=True)
class ActorChange:
    """What all edits of one actor come to, in exact numbers.

    Attributes:
        removed: whether the actor is taken away.
        forward_m: shift in the direction that it faces in the recording, metres.
        left_m: shift to its left, metres.
        up_m: shift away from the ground, metres.
        turn_deg: turn to the left, degrees in [0, 360).
        delay_s: by how much later it drives, seconds.
        speed_factor: of its speed.
    """

    removed: bool = False
    forward_m: Fraction = Fraction(0)
    left_m: Fraction = Fraction(0)
    up_m: Fraction = Fraction(0)
    turn_deg: Fraction = Fraction(0)
    delay_s: Fraction = Fraction(0)
    speed_factor: Fraction = Fraction(1)

    @property
    def is_identity(self) -> bool:
        """Whether the actor stays as it was recorded."""
        return self == ActorChange()

    @property
    def keeps_motion(self) -> bool:
        """Whether the actor is at the same point of its path at every moment."""
        return not self.delay_s and self.speed_factor == 1


def combine_changes(edits: Iterable[ChangeOfActor]) -> ActorChange:
    """Combines several edits of one actor, exactly: what is moved away and back is where it was.

    Shifts are along the recorded axes and turns about the actor's centre, so that their order does not count.

    Args:
        edits: of the same actor.

    Returns:
        One change; the identity where the edits cancel out.

    >>> combine_changes([Move(actor="1", left_m=0.1), Move(actor="1", left_m=0.2), Move(actor="1", left_m=-0.3)])
    ActorChange(removed=False, forward_m=Fraction(0, 1), left_m=Fraction(0, 1), ... speed_factor=Fraction(1, 1))
    """
    change = ActorChange()
    for edit in edits:
        if isinstance(edit, Remove):
            change = replace(change, removed=True)
        elif isinstance(edit, Move):
            change = replace(
                change,
                forward_m=change.forward_m + to_fraction(edit.forward_m),
                left_m=change.left_m + to_fraction(edit.left_m),
                up_m=change.up_m + to_fraction(edit.up_m),
            )
        elif isinstance(edit, Rotate):
            change = replace(change, turn_deg=(change.turn_deg + to_fraction(edit.degrees)) % 360)
        elif isinstance(edit, Retime):
            change = replace(change, delay_s=change.delay_s + to_fraction(edit.delay_s))
        else:
            change = replace(change, speed_factor=change.speed_factor * to_fraction(edit.factor))
    return change


def to_fraction(value: float) -> Fraction:
    """Converts a number to the exact decimal that a person wrote: 0.1 is a tenth.

    Args:
        value: finite.

    >>> to_fraction(0.1) + to_fraction(0.2) == to_fraction(0.3)
    True
    """
    # By its shortest decimal, as the binary number that is nearest to 0.1 is no tenth.
    return Fraction(repr(value))
