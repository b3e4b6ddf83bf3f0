"""Configuration keys of earlier versions: what they are called now, or what to do instead."""

from __future__ import annotations

# An old key is an error and not an alias: with aliases every key would keep two names for good.
RENAMED_KEYS = {
    "ingest.walls": "ingest.complete_facades",
    "gnet.finish": "gnet.refine",
    "gnet.refine.share": "gnet.refine.fraction_of_iterations",
    "gnet.refine.split": "gnet.refine.split_fraction",
    "gnet.refine.rates_before": "gnet.refine.lr_before_refine",
    "gnet.per_scene.means_rate": "gnet.per_scene.means_lr",
    "gnet.per_scene.means_rate_end": "gnet.per_scene.means_lr_end_fraction",
    "gnet.per_scene.log_scales_rate": "gnet.per_scene.log_scales_lr",
    "gnet.per_scene.quats_rate": "gnet.per_scene.quats_lr",
    "gnet.per_scene.logit_opacities_rate": "gnet.per_scene.logit_opacities_lr",
    "gnet.per_scene.sh_rate": "gnet.per_scene.sh_lr",
    **{
        f"{section}.{old}": f"{section}.{new}"
        for section in ("gnet", "enet")
        for old, new in (
            ("rates", "learning_rates"),
            ("adam.rates", "adam.learning_rates"),
            ("hold_ground", "constrain_ground"),
            ("split", "split_fraction"),
        )
    },
}
"""Keys of version 0.1 and what they are called since; an old key is an error that names the new one."""

REMOVED_KEYS = {
    "effects.fixer_per_view": "It changed nothing; fnet.gate decides which views are fixed.",
    "training": "Training commands read their own recipes; delete the section.",
}
"""Keys of version 0.1 that are gone, and what to do instead."""
