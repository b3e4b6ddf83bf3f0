"""The stages behind the weights of GNet and ENet that ship with the project."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

from flows.training.fixed_images import FixedImages
from flows.training.scene_lists import SceneList
from flows.training.scene_starts import ByGnet
from flows.training.stage_recipe import Stage, enet_config, gnet_config, starts_by_gnet, starts_by_long_gnet
from genre_tasks.config import LossConfig
from genre_tasks.learned.network import NetworkConfig
from genre_tasks.optimiser.tuned_adam import ENET_LEARNING_RATES, GNET_LEARNING_RATES

GNET_NETWORK = NetworkConfig(rates=GNET_LEARNING_RATES.as_tuple())
ENET_NETWORK = NetworkConfig(rates=ENET_LEARNING_RATES.as_tuple())
# The last stages of GNet and of ENet train nothing: their learning rates were swept over complete optimisations
# (benchmarks/optimiser/rate_sweep.py), which are longer than meta-training can unroll.
GNET_RESIDUAL_NETWORK = NetworkConfig(rates=(0.32, 0.32, 0.05, 0.3, 0.004883), residuals=True, relaxation=-0.47)
ENET_RESIDUAL_NETWORK = NetworkConfig(rates=ENET_LEARNING_RATES.as_tuple(), residuals=True, relaxation=-1.1)
ENET_SWEPT_NETWORK = ENET_RESIDUAL_NETWORK.model_copy(update={"rates": (0.256, 0.4096, 0.064, 0.384, 0.016)})

COARSE = SceneList("coarse", 40)
FINE = SceneList("fine", 15)
DENSE = SceneList("dense", 28, real=3)
NO_TRAINING = SceneList("coarse", 1, real=0)

GNET_STAGES = (
    Stage("gnet/coarse", None, GNET_NETWORK, COARSE, config=gnet_config(steps=1200, learning_rate=2.5e-3, seed=0)),
    Stage("gnet/fine", "gnet/coarse", GNET_NETWORK, FINE, config=gnet_config(steps=240, learning_rate=5e-4, seed=1)),
    Stage("gnet/finer", "gnet/fine", GNET_NETWORK, FINE, config=gnet_config(steps=240, learning_rate=5e-4, seed=2)),
    # From here on the held-out loss counts four times as much: the aim is views that the optimiser does not see.
    Stage(
        "gnet/unseen",
        "gnet/finer",
        GNET_NETWORK,
        FINE,
        config=gnet_config(steps=200, learning_rate=7e-4, seed=3, held_out_weight=4.0),
    ),
    Stage(
        "gnet/many",
        "gnet/unseen",
        GNET_NETWORK,
        replace(FINE, real=2),
        config=gnet_config(steps=110, learning_rate=6e-4, seed=4, held_out_weight=4.0, views=(6, 15, 30)),
    ),
    # On scenes of full size the meta-gradient is taken through a fifth of the Gaussians, which saves memory and time.
    Stage(
        "gnet/dense",
        "gnet/many",
        GNET_NETWORK,
        DENSE,
        config=gnet_config(
            steps=420,
            learning_rate=5e-4,
            seed=41,
            held_out_weight=4.0,
            held_out_views=6,
            sample=0.2,
            iterations=(24, 48, 48, 72),
            views=(6, 15, 15, 30),
        ),
    ),
    Stage("gnet/told", "gnet/dense", GNET_RESIDUAL_NETWORK, NO_TRAINING, config=gnet_config(steps=0)),
)
"""GNet from nothing. The last stage gives the network image residuals as inputs, and trains nothing."""


def _strides_stage(name: str, initial_weights: str, gnet_stage: str, **settings: Any) -> Stage:
    """ENet at GNet's learning rates, on scenes as that stage of GNet leaves them."""
    config = enet_config(
        held_out_weight=3.0,
        held_out_views=6,
        sample=0.25,
        views=(4, 6),
        novel_views=8,
        iterations=(8, 12, 12, 16, 24),
        loss=LossConfig(perceptual=0.1, perceptual_every=1),
        held_out_loss=LossConfig(perceptual=1.0, perceptual_every=1, depth=0.0),
        **settings,
    )
    return Stage(
        name,
        initial_weights,
        GNET_NETWORK,
        replace(DENSE, count=19, real=2),
        config=config,
        starts=starts_by_long_gnet(gnet_stage),
        fixed_images=FixedImages("fnet"),
    )


def _many_stage(name: str, initial_weights: str, **settings: Any) -> Stage:
    """ENet with many iterations of few views, with residuals; only the held-out loss has a perceptual term."""
    config = enet_config(
        held_out_weight=3.0,
        held_out_views=6,
        sample=0.25,
        views=(3,),
        novel_views=3,
        pool=6,
        segment=8,
        loss=LossConfig(perceptual=0.0),
        held_out_loss=LossConfig(perceptual=1.0, perceptual_every=1, depth=0.0),
        **settings,
    )
    return Stage(
        name,
        initial_weights,
        ENET_RESIDUAL_NETWORK,
        replace(DENSE, count=12, real=1),
        config=config,
        starts=(ByGnet("gnet/told", iterations=72, views=3),),
        fixed_images=FixedImages("fnet"),
        new_head=True,
        split_fraction=0.45,
    )


ENET_STAGES = (
    # With stand-ins for FNet's images, so that FNet need not be trained yet.
    Stage(
        "enet/coarse",
        "gnet/coarse",
        ENET_NETWORK,
        SceneList("coarse", 24, real=0),
        config=enet_config(steps=300, learning_rate=1e-3, seed=0),
        starts=starts_by_gnet("gnet/coarse"),
        fixed_images=FixedImages("stand_in"),
    ),
    Stage(
        "enet/fine",
        "enet/coarse",
        ENET_NETWORK,
        FINE,
        config=enet_config(steps=160, learning_rate=5e-4, seed=1),
        starts=starts_by_gnet("gnet/fine"),
        fixed_images=FixedImages("fnet"),
    ),
    Stage(
        "enet/dense",
        "enet/fine",
        ENET_NETWORK,
        replace(DENSE, count=19, real=2),
        config=enet_config(
            steps=500,
            learning_rate=6e-4,
            seed=51,
            held_out_weight=3.0,
            held_out_views=6,
            sample=0.25,
            views=(4, 6),
            novel_views=8,
            loss=LossConfig(perceptual=0.1, perceptual_every=1),
            held_out_loss=LossConfig(perceptual=0.3, perceptual_every=1, depth=0.0),
        ),
        starts=starts_by_long_gnet("gnet/many"),
        fixed_images=FixedImages("fnet"),
    ),
    _strides_stage("enet/strides", "enet/dense", "gnet/many", steps=300, learning_rate=5e-4, seed=71),
    _strides_stage("enet/held", "enet/strides", "gnet/dense", steps=300, learning_rate=2.5e-4, seed=81),
    _many_stage("enet/many", "enet/held", steps=800, learning_rate=1e-3, seed=91, iterations=(48, 72)),
    Stage("enet/swept", "enet/many", ENET_SWEPT_NETWORK, NO_TRAINING, config=enet_config(steps=0)),
)
"""ENet from GNet's weights after their coarse stage.

First at 160 × 90 pixels with stand-ins for FNet's images, then with FNet's. Then at GNet's learning rates, which take
steps twice as far, and once more on scenes whose ground was constrained. Then with a new last layer, for many cheap
iterations instead of a few costly ones, on scenes whose Gaussians are split. The last stage trains nothing.
"""
