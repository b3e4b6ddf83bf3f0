"""The effects' plan with which a scene is evaluated whose images had another size than those it is compared with."""

from __future__ import annotations

from dataclasses import replace

from genre_tasks.effects.types import EffectsPlan


def take_ego_pixels(plan: EffectsPlan, reference: EffectsPlan) -> EffectsPlan:
    """Gives a plan the recording vehicle's pixels of images of another size.

    Poses, gains, shutters, blurs and decisions stay those that the scene was fitted with: an effect may be called for
    at one size of images and not at another.

    Args:
        plan: of the images that the scene was fitted to.
        reference: of the same chunk, at the size at which the scene is compared.

    Returns:
        The plan, with the decision, masks and points of ``ego_mask`` from the reference.
    """
    parameters = replace(
        plan.parameters,
        ego_masks=reference.parameters.ego_masks,
        # Rows of the reference's points, whose number the size of the images may change.
        ego_points=reference.parameters.ego_points,
    )
    decisions = tuple(reference[d.name] if d.name == "ego_mask" else d for d in plan.decisions)
    return EffectsPlan(decisions, parameters)
