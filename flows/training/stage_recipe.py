"""One stage of a training, and the settings that stages of GNet and of ENet share."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from flows.training.fixed_images import FixedImages
from flows.training.scene_lists import SceneList
from flows.training.scene_starts import Adam, ByGnet, Initial, SceneStart
from genre_tasks.config import LossConfig
from genre_tasks.learned.meta_training import MetaConfig
from genre_tasks.learned.network import NetworkConfig

SHIPPED = "builtin:"
"""Prefix of weights that ship with the project."""

GNET_LOSS = LossConfig(perceptual=0.0)
"""The loss that the optimiser descends in GNet's training."""

GNET_HELD_OUT_LOSS = LossConfig(perceptual=0.0, depth=0.0, novel=0.1)
"""The loss on held-out frames and true novel views, with λ_novel = 0.1 (paper Sec. III-D)."""

ENET_LOSS = LossConfig(perceptual=0.02, perceptual_every=2)
ENET_HELD_OUT_LOSS = LossConfig(perceptual=0.05, perceptual_every=1, depth=0.0)


@dataclass(frozen=True)
class Stage:
    """One stage of a training.

    Attributes:
        name: the network and a part (``gnet/coarse``): the folder it is trained in, and what later stages call its
            weights.
        initial_weights: the stage whose weights it starts from, or those that ship (``builtin:gnet``); ``None`` for
            new weights.
        network: the network's shape and its learning rates.
        scenes: what it is trained on.
        config: length, views, losses and learning rate of meta-training.
        starts: where scenes begin, in turn.
        fixed_images: which images it is shown at novel views, if any.
        new_head: the last layer starts anew.
        split_fraction: fraction of the Gaussians that is split before the optimisation, as ENet does.
    """

    name: str
    initial_weights: str | None
    network: NetworkConfig
    scenes: SceneList
    config: MetaConfig
    starts: tuple[SceneStart, ...] = (Initial(),)
    fixed_images: FixedImages | None = None
    new_head: bool = False
    split_fraction: float = 0.0

    @property
    def network_name(self) -> str:
        """The network: gnet, enet or g3r."""
        return self.name.split("/", maxsplit=1)[0]

    def required_stages(self) -> tuple[str, ...]:
        """Lists the stages whose weights take part.

        Returns:
            Their names, each once; weights that ship are not among them.
        """
        # A stage depends on weights in three ways: those it starts from, and those that made its scenes or the scenes
        # whose renders are fixed.
        starts = list(self.starts)
        if self.fixed_images is not None and self.fixed_images.rendered is not None:
            starts.append(self.fixed_images.rendered)
        by_gnet = [start.stage for start in starts if isinstance(start, ByGnet)]
        # Weights that ship are there already, so no stage has to be trained for them.
        weights = self.initial_weights
        before = [weights] if weights and not weights.startswith(SHIPPED) else []
        return tuple(dict.fromkeys([*before, *by_gnet]))


def gnet_config(**settings: Any) -> MetaConfig:
    """Gives the settings that stages of GNet share.

    Args:
        settings: what the stage sets itself, as for ``MetaConfig``.

    Returns:
        All settings.
    """
    usual: dict[str, Any] = {"pool": 6, "loss": GNET_LOSS, "held_out_loss": GNET_HELD_OUT_LOSS}
    return MetaConfig(**{**usual, **settings})


def enet_config(**settings: Any) -> MetaConfig:
    """Gives the settings that stages of ENet share.

    Args:
        settings: what the stage sets itself, as for ``MetaConfig``.

    Returns:
        All settings.
    """
    # Few iterations, and no change of the start's sizes and opacities: ENet always begins near a finished scene.
    usual: dict[str, Any] = {
        "pool": 5,
        "iterations": (8, 12, 12, 16),
        "views": (4, 6, 6),
        "novel_views": 6,
        "held_out_weight": 2.0,
        "log_scale_spread": 0.0,
        "logit_spread": 0.0,
        "loss": ENET_LOSS,
        "held_out_loss": ENET_HELD_OUT_LOSS,
    }
    return MetaConfig(**{**usual, **settings})


def starts_by_gnet(stage: str) -> tuple[SceneStart, ...]:
    """Lists starts for ENet: two of three scenes as a GNet leaves them, the others as tuned Adam does at several ages.

    Args:
        stage: the stage of GNet whose weights are used.

    Returns:
        The starts in turn.
    """
    # ENet must repair scenes that GNet did not make, too.
    return tuple(start for age in (24, 48, 96) for start in (ByGnet(stage), ByGnet(stage), Adam(age)))


def starts_by_long_gnet(stage: str) -> tuple[SceneStart, ...]:
    """Lists starts as :func:`starts_by_gnet`, with three of four by a GNet of 48 or 72 iterations of three views.

    Args:
        stage: the stage of GNet whose weights are used.

    Returns:
        The starts in turn.
    """
    medium = ByGnet(stage, iterations=48, views=3)
    long = ByGnet(stage, iterations=72, views=3)
    return tuple(start for age in (24, 48, 96) for start in (medium, medium, long, Adam(age)))
