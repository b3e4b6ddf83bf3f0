"""Stages that no shipped weights come from: the paper's order, and training with effects against training without."""

from __future__ import annotations

from dataclasses import replace

from flows.training.fixed_images import FixedImages
from flows.training.scene_lists import SceneList
from flows.training.scene_starts import Adam, PerScene, SceneStart
from flows.training.shipped_stages import COARSE, ENET_NETWORK, FINE, GNET_NETWORK, GNET_RESIDUAL_NETWORK
from flows.training.stage_recipe import Stage, enet_config, gnet_config, starts_by_gnet

# Tuned Adam stands between the ages of 3DGS, so that ENet does not only meet the errors of one method.
STARTS_BY_3DGS: tuple[SceneStart, ...] = (
    PerScene(120, 960),
    Adam(24),
    PerScene(480, 960),
    Adam(48),
    PerScene(960, 960),
    Adam(96),
)

# ENet comes first and GNet is fine-tuned from it: the other way round than the shipped weights.
PAPER_STAGES = (
    Stage(
        "enet/coarse_3dgs",
        None,
        ENET_NETWORK,
        SceneList("coarse", 24, real=0, rounds=2),
        config=enet_config(steps=900, learning_rate=2.5e-3, seed=0),
        starts=STARTS_BY_3DGS,
        fixed_images=FixedImages("stand_in"),
    ),
    Stage(
        "enet/3dgs",
        "enet/coarse_3dgs",
        ENET_NETWORK,
        replace(FINE, rounds=2),
        config=enet_config(steps=240, learning_rate=5e-4, seed=1),
        starts=STARTS_BY_3DGS,
        fixed_images=FixedImages("fnet"),
    ),
    Stage("gnet/coarse", "enet/3dgs", GNET_NETWORK, COARSE, config=gnet_config(steps=900, learning_rate=2e-3, seed=2)),
    Stage(
        "gnet/fine",
        "gnet/coarse",
        GNET_NETWORK,
        FINE,
        config=gnet_config(steps=400, learning_rate=6e-4, seed=3, held_out_weight=4.0),
    ),
    Stage(
        "enet/gnet",
        "enet/3dgs",
        ENET_NETWORK,
        FINE,
        config=enet_config(steps=200, learning_rate=5e-4, seed=4),
        starts=starts_by_gnet("gnet/fine"),
        fixed_images=FixedImages("fnet"),
    ),
)
"""The paper's order (Sec. III-D): ENet on 3DGS scenes, GNet fine-tuned from it, ENet on GNet's scenes too.

Lengths and learning rates are not tuned yet; no weights that ship were trained so.
"""

_WITHOUT_EFFECTS = SceneList("dense", 12)


def _further_stage(name: str, scenes: SceneList) -> Stage:
    """The weights that ship, trained further on such scenes."""
    config = gnet_config(
        steps=200,
        learning_rate=2.5e-4,
        seed=91,
        held_out_weight=4.0,
        held_out_views=6,
        sample=0.2,
        iterations=(24, 48, 72),
        views=(3, 6, 15),
    )
    return Stage(name, "builtin:gnet", GNET_RESIDUAL_NETWORK, scenes, config=config)


# The same training twice, which differs in the scenes alone: so a difference of the weights is due to the effects.
EFFECTS_STAGES = (
    _further_stage("gnet/plain", _WITHOUT_EFFECTS),
    _further_stage("gnet/effects", replace(_WITHOUT_EFFECTS, planned=True)),
)
"""Whether it pays to train on logs that have effects."""
