"""A chunk with edited traffic as a store keeps it: as ``ingest`` makes chunks, with a plan that readers apply again."""

from __future__ import annotations

from dataclasses import replace

from genre_tasks.effects.apply_plan import apply_plan
from genre_tasks.effects.types import Decision, EffectParameters, EffectsPlan
from genre_tasks.scene.chunk import Actor, Chunk

_EFFECT = "rigid_actors"


def prepare_stored_chunk(ingested: Chunk, plan: EffectsPlan, actors: tuple[Actor, ...]) -> tuple[Chunk, EffectsPlan]:
    """Gives a chunk other actors, and a plan under which its readers find them.

    A plan may have no rigid actors, as in a street without traffic. Applied again, it would make the actors of an edit
    background.

    Args:
        ingested: as ``ingest`` made it.
        plan: of that chunk.
        actors: those of the edited chunk.

    Returns:
        The chunk, to which no parameter of the plan is applied, and its plan: ``plan`` itself where that fits.
    """
    # Actors of the log that the plan makes background stay that.
    background = apply_plan(ingested, replace(plan, parameters=EffectParameters())).static
    chunk = replace(ingested, static=background, actors=actors)
    if not actors or plan.is_on(_EFFECT):
        return chunk, plan
    return chunk, replace(plan, decisions=tuple(_turn_on(d) if d.name == _EFFECT else d for d in plan.decisions))


def _turn_on(decision: Decision) -> Decision:
    return replace(decision, choice="on", reason=f"an edit put actors here; as recorded: {decision.reason}")
