"""Which terms of the loss a stage has, as the effects' plan decides."""

from __future__ import annotations

from genre_tasks.config import GnetConfig, OptimiserConfig
from genre_tasks.effects.types import EffectsPlan
from genre_tasks.errors import ConfigError
from genre_tasks.scene.chunk import Chunk
from genre_tasks.stages.optimise import PER_SCENE_METHODS


def drop_unplanned_losses(config: OptimiserConfig, plan: EffectsPlan, chunk: Chunk | None = None) -> OptimiserConfig:
    """Leaves out the loss terms that the effects' plan leaves out.

    Args:
        config: a stage's section.
        plan: of the chunk's effects.
        chunk: that the plan is of, to be named in an error.

    Returns:
        OptimiserConfig: without terms for depth, if the plan has LiDAR depth off.

    Raises:
        ConfigError: no term is left.
    """
    # A weight of 0 and not a missing target: the loss is then the same code for every plan.
    if plan.is_on("lidar_depth"):
        return config
    _require_other_term(config, chunk)
    update: dict[str, object] = {"loss": config.loss.model_copy(update={"depth": 0.0})}
    if isinstance(config, GnetConfig):
        update["per_scene"] = config.per_scene.model_copy(update={"depth": 0.0})
    return config.model_copy(update=update)


def _require_other_term(config: OptimiserConfig, chunk: Chunk | None) -> None:
    """Raises where depth is the only term of the loss that the method uses."""
    if isinstance(config, GnetConfig) and config.method in PER_SCENE_METHODS:
        section = "per_scene"
        weights = {"rgb": config.per_scene.rgb, "ssim": config.per_scene.ssim}
    else:
        section = "loss"
        weights = {"rgb": config.loss.rgb, "perceptual": config.loss.perceptual, "ssim": config.loss.ssim}
    if any(weights.values()):
        return
    # The configuration's own check cannot know the plan; without any term the scene would stay as it is.
    raise ConfigError(
        f"depth is the only term of {section} that has a weight, and the effects' plan has lidar_depth off: "
        "nothing would be optimised",
        remedy=f"Give {' or '.join(f'{section}.{name}' for name in weights)} a weight, or set effects.lidar_depth=on.",
        log=None if chunk is None else chunk.log,
        chunk=None if chunk is None else chunk.index,
    )
