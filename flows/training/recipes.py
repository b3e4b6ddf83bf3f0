"""The recipes of training: tables of stages, each listed after those that it needs."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from flows.training.paper_stages import EFFECTS_STAGES, PAPER_STAGES
from flows.training.shipped_stages import ENET_STAGES, GNET_STAGES
from flows.training.stage_recipe import SHIPPED, Stage
from genre_tasks.errors import ConfigError

RECIPES: dict[str, tuple[Stage, ...]] = {
    "shipped": GNET_STAGES + ENET_STAGES,
    "paper": PAPER_STAGES,
    "effects": EFFECTS_STAGES,
}


def get_recipe(recipe: str, novel: float | None = None) -> tuple[Stage, ...]:
    """Finds the stages of a recipe and checks their order.

    Args:
        recipe: ``shipped``, ``paper`` or ``effects``.
        novel: λ_novel of GNet's stages; ``None`` for the recipe's. 0 gives G3R, trained on recorded views alone. Its
            stages are called ``g3r/…``: they use no image at novel views, nor weights that were trained with one.

    Returns:
        The stages in the order of training.

    Raises:
        ConfigError: the recipe is unknown, two stages share a name, or a stage comes before one that it needs.

    >>> [stage.name for stage in get_recipe("effects", novel=0)]
    ['g3r/plain', 'g3r/effects']
    """
    if recipe not in RECIPES:
        raise ConfigError(f"no recipe is called {recipe!r}", remedy=f"Known: {', '.join(RECIPES)}.")
    stages = RECIPES[recipe]
    if novel is not None:
        stages = tuple(_with_novel(stage, novel) for stage in stages if novel or stage.network_name == "gnet")
    listed: list[str] = []
    for stage in stages:
        # The name is also the folder, so two stages would overwrite each other's weights.
        if stage.name in listed:
            raise ConfigError(f"two stages are called {stage.name}", remedy="Rename one of them.")
        if missing := [name for name in stage.required_stages() if name not in listed]:
            raise ConfigError(
                f"{stage.name} needs {' and '.join(missing)}, which the recipe {recipe} does not list before it",
                remedy="List the stages in the order of training.",
            )
        listed.append(stage.name)
    return stages


def select_stages(stages: Sequence[Stage], network: str) -> list[Stage]:
    """Selects the stages of a network and all that they need.

    Args:
        stages: a recipe's stages, in order.
        network: gnet, enet or g3r.

    Returns:
        The stages in the recipe's order.

    Raises:
        ConfigError: the recipe has no stage of the network.
    """
    wanted = {stage.name for stage in stages if stage.network_name == network}
    if not wanted:
        raise ConfigError(f"the recipe has no stage of {network}", remedy="Choose another recipe or network.")
    # From the end, since a stage only needs stages before it: one pass finds what those need in turn.
    for stage in reversed(stages):
        if stage.name in wanted:
            wanted.update(stage.required_stages())
    return [stage for stage in stages if stage.name in wanted]


def _with_novel(stage: Stage, novel: float) -> Stage:
    """A stage of GNet with another λ_novel; others as they are."""
    if stage.network_name != "gnet":
        return stage
    held_out_loss = stage.config.held_out_loss.model_copy(update={"novel": novel})
    config = stage.config.model_copy(update={"held_out_loss": held_out_loss})
    if novel > 0:
        return replace(stage, config=config)
    weights = stage.initial_weights
    # Weights of ENet's stages were trained with images at novel views: G3R begins anew instead.
    if weights is not None:
        weights = weights.replace("gnet", "g3r") if weights.startswith(("gnet/", SHIPPED)) else None
    return replace(
        stage,
        name=stage.name.replace("gnet/", "g3r/"),
        initial_weights=weights,
        config=config.model_copy(update={"novel_views": 0}),
        fixed_images=None,
    )
