"""What a behaviour is planned from: the recorded path, its reference, and what the user asks for."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from genre_tasks.config.simulation_sections import SimulateConfig
from genre_tasks.ego_paths.ego_path import EgoPath
from genre_tasks.ego_paths.reference_path import ReferencePath

Side = Literal["left", "right"]


@dataclass(frozen=True)
class BehaviourRequest:
    """A behaviour that a user asks for.

    Attributes:
        name: of the behaviour.
        recorded: one pose for each log frame.
        reference: of the recorded path.
        config: bounds, and what strength 1 stands for.
        start_offset_m: to the left of the recorded path; negative: to the right.
        strength: from 0, which leaves the recorded driving as it is.
        delay_s: seconds from the first pose to the begin of the manoeuvre.
        side: towards which the vehicle moves; ``None``: see ``signed_side``.
        allow_implausible: whether a path may break the bounds.
    """

    name: str
    recorded: EgoPath
    reference: ReferencePath
    config: SimulateConfig
    start_offset_m: float
    strength: float
    delay_s: float
    side: Side | None
    allow_implausible: bool = False

    @property
    def signed_side(self) -> int:
        """1 for the left and -1 for the right; by default the side of the recorded path, or the left on it."""
        if self.side is not None:
            return 1 if self.side == "left" else -1
        return -1 if self.start_offset_m > 0 else 1
