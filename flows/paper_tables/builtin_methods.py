"""The methods that the paper's tables have: registry entries, each a few settings over a preset and an end."""

from __future__ import annotations

from collections.abc import Mapping

from flows.paper_tables.methods import Method

# What the published per-scene methods do not model stays off, whatever the chunk's plan says.
_AS_PUBLISHED = ("effects.rolling_shutter=off", "effects.exposure=off", "effects.anti_aliasing=off")
# Per-scene distillation: the variant of tuned Adam that `genre bench optimiser` found to distil best (3 + 3 views an
# iteration at half of the learning rates, no perceptual term), long enough to settle.
_DISTILLED = (
    "enet.method=adam",
    "enet.iterations=480",
    "enet.views_per_iteration=3",
    "enet.novel_views_per_iteration=3",
    "enet.adam.learning_rates={means: 0.05, log_scales: 0.05, quats: 0.0125, logit_opacities: 0.075, colors: 0.005}",
    "enet.adam.schedule=constant",
    "enet.loss.perceptual=0",
    "enet.split_fraction=0",
)
# Written out, so that a user's settings for all methods cannot turn the learned ones into others.
_LEARNED = ("gnet.method=learned", "enet.method=learned")
_STREET_GS = ("gnet.method=street_gs", *_AS_PUBLISHED)
# The scene is another program's work, and starts ENet as it is.
_AS_GIVEN = ("gnet.method=none",)
_ONE_SHOT = "Distilled by Adam, 480 iterations of 3 + 3 views; once, at 3 m, not progressively."

BUILT_IN: Mapping[str, Method] = {
    "3dgs": Method(
        "3DGS",
        ("gnet.method=standard_3dgs", *_AS_PUBLISHED),
        "gnet",
        "Per scene, everything static but the distant shell; no rolling shutter, exposure or anti-aliasing.",
    ),
    "streetgs": Method(
        "StreetGS-style",
        _STREET_GS,
        "gnet",
        "Per scene with actors in their boxes; no rolling shutter, exposure or anti-aliasing; without Street "
        "Gaussians' sky cubemap, tracking, semantics and Fourier colours.",
    ),
    "splatad": Method(
        "SplatAD-style",
        ("gnet.method=street_gs", "gnet.per_scene.depth=0.01", "effects.anti_aliasing=off"),
        "gnet",
        "StreetGS-style with rolling shutter and exposure where the chunk's plan has them and a LiDAR depth term; "
        "without SplatAD's decoder of features, LiDAR rendering and learned offsets of poses.",
    ),
    "g3r": Method(
        "G3R-style",
        ("gnet.method=g3r",),
        "gnet",
        "GNet's network trained on recorded views alone (λ_novel = 0), with weights of its own.",
    ),
    "gnet": Method("GNet", _LEARNED, "gnet"),
    "streetcrafter": Method(
        "StreetCrafter-style",
        (*_STREET_GS, *_DISTILLED),
        "enet",
        f"StreetGS-style scene → novel views → fixer → per-scene distillation. {_ONE_SHOT}",
        slot="streetcrafter",
        stand_in="No fixer with StreetCrafter's inputs (reference + LiDAR) is shipped: FNet with all inputs "
        "stands in, so that this row and Difix3D-style are one recipe.",
    ),
    "difix": Method(
        "Difix3D-style",
        (*_STREET_GS, *_DISTILLED),
        "enet",
        f"StreetGS-style scene → novel views → fixer → per-scene distillation. {_ONE_SHOT}",
        slot="difix",
        stand_in="No fixer with Difix3D's inputs (render + reference) is shipped: FNet with all inputs stands in.",
    ),
    "genre+": Method("GenRe+", _LEARNED, "enet", "GNet → FNet → ENet, as the preset has them."),
    "3dgs+genre": Method(
        "3DGS + GenRe",
        (*_LEARNED, "gnet.method=standard_3dgs", *_AS_PUBLISHED),
        "enet",
        "The shipped ENet, which was trained on scenes of GNet and of tuned Adam, not on 3DGS's as in the paper.",
    ),
    "g3r+genre": Method(
        "G3R-style + GenRe (zero-shot)",
        (*_LEARNED, "gnet.method=g3r"),
        "enet",
        "The shipped ENet, which was trained on scenes of GNet and of tuned Adam and never saw G3R's.",
    ),
    "g3r+genre-tuned": Method(
        "G3R-style + GenRe (fine-tuned)",
        (*_LEARNED, "gnet.method=g3r", "enet.learning_rates=null"),
        "enet",
        slot="enet-g3r",
        needs_weights=True,
    ),
    "scene": Method("Scene as given", _AS_GIVEN, "gnet", "Rendered as it is, nothing optimised."),
    "scene+genre": Method(
        "Scene + GenRe",
        (*_LEARNED, *_AS_GIVEN),
        "enet",
        "The shipped ENet, which was trained on scenes of GNet and of tuned Adam, not on scenes of other programs.",
    ),
    "scene+difix": Method(
        "Scene + Difix3D-style",
        (*_AS_GIVEN, *_DISTILLED),
        "enet",
        f"The scene → novel views → fixer → per-scene distillation. {_ONE_SHOT}",
        slot="difix",
        stand_in="No fixer with Difix3D's inputs (render + reference) is shipped: FNet with all inputs stands in.",
    ),
    "gnet-gnet": Method(
        "GNet → FNet → GNet",
        (
            *_LEARNED,
            "enet.weights=builtin:gnet",
            "enet.learning_rates=null",
            "enet.iterations={gnet.iterations}",
            "enet.views_per_iteration={gnet.views_per_iteration}",
            "enet.novel_views_per_iteration={gnet.views_per_iteration}",
        ),
        "enet",
        "ENet's stage and loss with GNet's weights, its number of iterations, and its views of each kind.",
    ),
    "gnet-enet": Method("GNet → FNet → ENet", _LEARNED, "enet", "As the preset has them."),
    "fixer-streetcrafter": Method(
        "StreetCrafter-V's inputs",
        _LEARNED,
        "fnet",
        slot="streetcrafter",
        needs_weights=True,
    ),
    "fixer-difix": Method("Difix3D's inputs", _LEARNED, "fnet", slot="difix", needs_weights=True),
    "fnet": Method("FNet", _LEARNED, "fnet"),
}
"""The methods by the names that table layouts use."""
