"""What the effects' plan of a chunk has beyond a scene of Gaussians, for people who export the scene."""

from __future__ import annotations

from genre_tasks.effects.types import EffectsPlan


def describe_plan_losses(plan: EffectsPlan) -> tuple[str, ...]:
    """Lists the effects of cameras that no file of Gaussians holds.

    Args:
        plan: of a chunk.

    Returns:
        Sentences.
    """
    parameters = plan.parameters
    losses = []
    if parameters.gains:
        losses.append(f"The exposure of {len(parameters.gains)} images is left out: colours are those of the mean one.")
    if parameters.shutters:
        losses.append("The rolling shutter of the cameras is left out.")
    if parameters.blurs:
        losses.append("The motion blur of the cameras is left out.")
    return tuple(losses)
