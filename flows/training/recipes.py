"""The recipes behind the weights of GNet and ENet: tables of stages, each a row that says all there is to say of it.

A stage's name is its network and its part (``gnet/coarse``): the folder it is trained in, and what later stages call
its weights. A table lists a stage after those that it needs.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

from flows.training.scene_starts import Adam, Begin, ByGnet, Initial, PerScene
from flows.training.fixed_images import Images
from flows.training.training_scenes import SceneRecipe
from genre_tasks.config import LossConfig
from genre_tasks.errors import ConfigError
from genre_tasks.optimiser.tuned_adam import ENET_RATES, GNET_RATES
from genre_tasks.learned.network import NetworkConfig
from genre_tasks.learned.meta_training import MetaConfig

SHIPPED = "builtin:"
CAMERAS = (3, 3, 3, 6, 3, 3, 2, 3)
EFFECTS = (
    "&rolling_shutter_s=0.02", "&distortion=0.02", "&exposure_jitter=0.2&white_balance_jitter=0.05", "&bonnet=0.08",
)
"""What a street may have, as queries: 6 to 12 px of rolling shutter, 5 px of distortion, 15 % of exposure, a bonnet."""
TOLD_RATES, TOLD_RELAXATION = (0.32, 0.32, 0.05, 0.3, 0.004883), -0.47
COARSE_POINTS, FINE_POINTS = (6_000, 8_000, 5_000, 10_000), (18_000, 20_000, 14_000, 24_000)
DENSE_POINTS, DENSE_REAL_POINTS = (18_000, 36_000, 14_000, 40_000), (18_000, 36_000, 40_000)

GNET_LOSS = LossConfig(perceptual=0.0)
"""What the optimiser sees in GNet's training."""
GNET_JUDGE = LossConfig(perceptual=0.0, depth=0.0, novel=0.1)
"""What judges it: held-out frames, and true novel views with λ_novel = 0.1 (paper Sec. III-D)."""
ENET_LOSS = LossConfig(perceptual=0.02, perceptual_every=2)
ENET_JUDGE = LossConfig(perceptual=0.05, perceptual_every=1, depth=0.0)

GNET_NETWORK, ENET_NETWORK = NetworkConfig(rates=GNET_RATES), NetworkConfig(rates=ENET_RATES)
MANY_NETWORK = NetworkConfig(rates=ENET_RATES, residuals=True, relaxation=-1.1)
SWEPT_NETWORK = MANY_NETWORK.model_copy(update={"rates": (0.256, 0.4096, 0.064, 0.384, 0.016)})
TOLD_NETWORK = NetworkConfig(rates=TOLD_RATES, residuals=True, relaxation=TOLD_RELAXATION)


@dataclass(frozen=True)
class SceneList:
    """Which chunks: ``count`` streets of a size, and before them the real log's scenes, ``real`` times.

    All of them ``rounds`` times: scene k of a round begins at the stage's begin k, in turn, and each round moves
    them on by one. ``planned``: scenes are as their plans of effects have them, and streets have up to four of
    :data:`EFFECTS`.
    """

    size: Literal["coarse", "fine", "dense"]
    count: int
    real: int = 1
    rounds: int = 1
    planned: bool = False


@dataclass(frozen=True)
class Stage:
    """One stage of a training.

    ``start``: the stage whose weights it starts from, or those that ship (``builtin:gnet``); ``None``: new weights.
    ``network`` has the rates; ``new_head``: the last layer starts anew. ``begins``: where scenes begin, in turn;
    ``split``: as ENet's, there. ``images``: what is seen beside the path.
    ``config``: T, views, losses, steps, rate.
    """

    name: str
    start: str | None
    network: NetworkConfig
    scenes: SceneList
    config: MetaConfig
    begins: tuple[Begin, ...] = (Initial(),)
    images: Images | None = None
    new_head: bool = False
    split: float = 0.0

    @property
    def of(self) -> str:
        """The network: gnet or enet."""
        return self.name.split("/", maxsplit=1)[0]

    def needs(self) -> tuple[str, ...]:
        """Names of the stages whose weights take part."""
        begins = [*self.begins, *([self.images.of] if self.images and self.images.of else [])]
        by = [begin.stage for begin in begins if isinstance(begin, ByGnet)]
        start = [self.start] if self.start and not self.start.startswith(SHIPPED) else []
        return tuple(dict.fromkeys([*start, *by]))


def _gnet(**more: Any) -> MetaConfig:
    return MetaConfig(**{"pool": 6, "loss": GNET_LOSS, "judge_loss": GNET_JUDGE, **more})


def _enet(**more: Any) -> MetaConfig:
    usual: dict[str, Any] = {
        "pool": 5, "iterations": (8, 12, 12, 16), "views": (4, 6, 6), "novel_views": 6, "judged": 2.0,
        "log_scale_spread": 0.0, "logit_spread": 0.0, "loss": ENET_LOSS, "judge_loss": ENET_JUDGE,
    }
    return MetaConfig(**{**usual, **more})


COARSE, FINE, DENSE = SceneList("coarse", 40), SceneList("fine", 15), SceneList("dense", 28, real=3)

GNET_STAGES = (
    Stage("gnet/coarse", None, GNET_NETWORK, COARSE, _gnet(steps=1200, rate=2.5e-3, seed=0)),
    Stage("gnet/fine", "gnet/coarse", GNET_NETWORK, FINE, _gnet(steps=240, rate=5e-4, seed=1)),
    Stage("gnet/finer", "gnet/fine", GNET_NETWORK, FINE, _gnet(steps=240, rate=5e-4, seed=2)),
    Stage("gnet/unseen", "gnet/finer", GNET_NETWORK, FINE, _gnet(steps=200, rate=7e-4, seed=3, judged=4.0)),
    Stage(
        "gnet/many", "gnet/unseen", GNET_NETWORK, replace(FINE, real=2),
        _gnet(steps=110, rate=6e-4, seed=4, judged=4.0, views=(6, 15, 30)),
    ),
    Stage(
        "gnet/dense", "gnet/many", GNET_NETWORK, DENSE,
        _gnet(
            steps=420, rate=5e-4, seed=41, judged=4.0, judges=6, sample=0.2, iterations=(24, 48, 48, 72),
            views=(6, 15, 15, 30),
        ),
    ),
    Stage("gnet/told", "gnet/dense", TOLD_NETWORK, SceneList("coarse", 1, real=0), _gnet(steps=0)),
)
"""GNet from nothing. The last stage trains nothing: the network is told residuals from there on, at rates that were
swept for whole optimisations (``benchmarks/optimiser/rate_sweep.py``)."""


def _of_gnet(stage: str) -> tuple[Begin, ...]:
    """Two of three scenes as a GNet leaves them, the others as tuned Adam does at several ages."""
    gnet = ByGnet(stage)
    return (gnet, gnet, Adam(24), gnet, gnet, Adam(48), gnet, gnet, Adam(96))


def _long(stage: str) -> tuple[Begin, ...]:
    """Three of four scenes as a GNet leaves them after 48 or 72 iterations of three views, the others by tuned Adam."""
    gnet, longer = ByGnet(stage, 48, 3), ByGnet(stage, 72, 3)
    return tuple(begin for age in (24, 48, 96) for begin in (gnet, gnet, longer, Adam(age)))


def _strides(name: str, start: str, gnet: str, **own: Any) -> Stage:
    """ENet at GNet's rates, on scenes as that stage of GNet leaves them."""
    config = _enet(
        judged=3.0, judges=6, sample=0.25, views=(4, 6), novel_views=8, iterations=(8, 12, 12, 16, 24),
        loss=LossConfig(perceptual=0.1, perceptual_every=1),
        judge_loss=LossConfig(perceptual=1.0, perceptual_every=1, depth=0.0), **own,
    )
    scenes = replace(DENSE, count=19, real=2)
    return Stage(name, start, GNET_NETWORK, scenes, config, _long(gnet), Images("fnet"))


def _many(name: str, start: str, **own: Any) -> Stage:
    """ENet with many iterations of few views, told residuals, without the perceptual term, which judges it alone."""
    config = _enet(
        judged=3.0, judges=6, sample=0.25, views=(3,), novel_views=3, pool=6, segment=8,
        loss=LossConfig(perceptual=0.0), judge_loss=LossConfig(perceptual=1.0, perceptual_every=1, depth=0.0), **own,
    )
    begins = (ByGnet("gnet/told", 72, 3),)
    scenes = replace(DENSE, count=12, real=1)
    return Stage(name, start, MANY_NETWORK, scenes, config, begins, Images("fnet"), new_head=True, split=0.45)


ENET_STAGES = (
    Stage(
        "enet/coarse", "gnet/coarse", ENET_NETWORK, SceneList("coarse", 24, real=0),
        _enet(steps=300, rate=1e-3, seed=0), _of_gnet("gnet/coarse"), Images("stand_in"),
    ),
    Stage(
        "enet/fine", "enet/coarse", ENET_NETWORK, FINE,
        _enet(steps=160, rate=5e-4, seed=1), _of_gnet("gnet/fine"), Images("fnet"),
    ),
    Stage(
        "enet/dense", "enet/fine", ENET_NETWORK, replace(DENSE, count=19, real=2),
        _enet(
            steps=500, rate=6e-4, seed=51, judged=3.0, judges=6, sample=0.25, views=(4, 6), novel_views=8,
            loss=LossConfig(perceptual=0.1, perceptual_every=1),
            judge_loss=LossConfig(perceptual=0.3, perceptual_every=1, depth=0.0),
        ),
        _long("gnet/many"), Images("fnet"),
    ),
    _strides("enet/strides", "enet/dense", "gnet/many", steps=300, rate=5e-4, seed=71),
    _strides("enet/held", "enet/strides", "gnet/dense", steps=300, rate=2.5e-4, seed=81),
    _many("enet/many", "enet/held", steps=800, rate=1e-3, seed=91, iterations=(48, 72)),
    Stage("enet/swept", "enet/many", SWEPT_NETWORK, SceneList("coarse", 1, real=0), _enet(steps=0)),
)
"""ENet from GNet's weights after their coarse stage: at 160×90 with stand-ins for FNet's images, then with those; at
GNet's rates, twice as far a step, and there once more on scenes whose ground was held; with a new last layer for many
cheap iterations instead of a few dear ones, on scenes whose Gaussians are split. The last stage trains nothing: its
rates were swept for whole optimisations (``benchmarks/optimiser/rate_sweep.py``)."""

AGED: tuple[Begin, ...] = (PerScene(120, 960), Adam(24), PerScene(480, 960), Adam(48), PerScene(960, 960), Adam(96))

PAPER_STAGES = (
    Stage(
        "enet/coarse_3dgs", None, ENET_NETWORK, SceneList("coarse", 24, real=0, rounds=2),
        _enet(steps=900, rate=2.5e-3, seed=0), AGED, Images("stand_in"),
    ),
    Stage(
        "enet/3dgs", "enet/coarse_3dgs", ENET_NETWORK, replace(FINE, rounds=2),
        _enet(steps=240, rate=5e-4, seed=1), AGED, Images("fnet"),
    ),
    Stage("gnet/coarse", "enet/3dgs", GNET_NETWORK, COARSE, _gnet(steps=900, rate=2e-3, seed=2)),
    Stage("gnet/fine", "gnet/coarse", GNET_NETWORK, FINE, _gnet(steps=400, rate=6e-4, seed=3, judged=4.0)),
    Stage(
        "enet/gnet", "enet/3dgs", ENET_NETWORK, FINE,
        _enet(steps=200, rate=5e-4, seed=4), _of_gnet("gnet/fine"), Images("fnet"),
    ),
)
"""The paper's order (Sec. III-D): ENet on 3DGS scenes, GNet fine-tuned from it, ENet on GNet's scenes too.

Lengths and rates are not tuned yet; no weights that ship were trained so.
"""

PLAIN = SceneList("dense", 12)


def _further(name: str, scenes: SceneList) -> Stage:
    """The weights that ship, trained further on such scenes."""
    config = _gnet(
        steps=200, rate=2.5e-4, seed=91, judged=4.0, judges=6, sample=0.2, iterations=(24, 48, 72), views=(3, 6, 15),
    )
    return Stage(name, "builtin:gnet", TOLD_NETWORK, scenes, config)


EFFECTS_STAGES = (_further("gnet/plain", PLAIN), _further("gnet/effects", replace(PLAIN, planned=True)))
"""Whether it pays to train on logs that have effects: the same training twice, without them and with."""

RECIPES: dict[str, tuple[Stage, ...]] = {
    "shipped": GNET_STAGES + ENET_STAGES, "paper": PAPER_STAGES, "effects": EFFECTS_STAGES,
}


def table_of(recipe: str, novel: float | None = None) -> tuple[Stage, ...]:
    """A recipe's stages, checked; ``novel`` is λ_novel of GNet's, 0: G3R, trained on recorded views alone.

    G3R's stages are called ``g3r/…``: they see no image beside the path, nor weights that were trained with one.
    Raises ``ConfigError`` for an unknown recipe, a name given twice, and a stage before one that it needs.
    """
    if recipe not in RECIPES:
        raise ConfigError(f"no recipe is called {recipe!r}", remedy=f"Known: {', '.join(RECIPES)}.")
    table = RECIPES[recipe]
    if novel is not None:
        table = tuple(_with_novel(stage, novel) for stage in table if novel or stage.of == "gnet")
    listed: list[str] = []
    for stage in table:
        if stage.name in listed:
            raise ConfigError(f"two stages are called {stage.name}", remedy="Rename one of them.")
        if missing := [name for name in stage.needs() if name not in listed]:
            raise ConfigError(
                f"{stage.name} needs {' and '.join(missing)}, which the recipe {recipe} does not list before it",
                remedy="List the stages in the order of training.",
            )
        listed.append(stage.name)
    return table


def _with_novel(stage: Stage, novel: float) -> Stage:
    """A stage of GNet with another λ_novel; others as they are."""
    if stage.of != "gnet":
        return stage
    judge = stage.config.judge_loss.model_copy(update={"novel": novel})
    config = stage.config.model_copy(update={"judge_loss": judge})
    if novel > 0:
        return replace(stage, config=config)
    config = config.model_copy(update={"novel_views": 0})
    start = None
    if stage.start and stage.start.startswith(("gnet/", SHIPPED)):
        start = stage.start.replace("gnet", "g3r")
    return replace(stage, name=stage.name.replace("gnet/", "g3r/"), start=start, config=config, images=None)


def ordered(table: Sequence[Stage], network: str) -> list[Stage]:
    """The stages of a network and all that they need, in the table's order. Raises ``ConfigError`` for none."""
    wanted = {stage.name for stage in table if stage.of == network}
    if not wanted:
        raise ConfigError(f"the recipe has no stage of {network}", remedy="Choose another recipe or network.")
    for stage in reversed(table):
        if stage.name in wanted:
            wanted.update(stage.needs())
    return [stage for stage in table if stage.name in wanted]


def scene_recipes(scenes: SceneList, real: str | None) -> list[SceneRecipe]:
    """One round of the list; ``real`` is the URI of a log with a chunk 0, or ``None``."""
    if scenes.size == "coarse":
        return coarse_scenes(scenes.count, real, scenes.real)
    if scenes.size == "dense":
        out = dense_scenes(scenes.count, real, scenes.real)
        return [_planned(recipe, k) for k, recipe in enumerate(out)] if scenes.planned else out
    return fine_scenes(scenes.count, real, scenes.real)


def coarse_scenes(count: int = 40, real: str | None = None, times: int = 1) -> list[SceneRecipe]:
    """Streets at 160×90, a quarter of the pixels and Gaussians: four times as many steps in the same time."""
    sizes: dict[str, Any] = {"distant_count": 800, "width_px": 160, "height_px": 90}
    out = []
    if real is not None:
        dense = {**sizes, "distant_count": 1_500}
        out = 2 * times * [SceneRecipe(real, max_points=6_000, **sizes), SceneRecipe(real, max_points=12_000, **dense)]
    for k in range(count):
        uri = _street((k * 37 + 11) % 900, k, "&width=160&height=90")
        out.append(SceneRecipe(uri, max_points=COARSE_POINTS[k % 4], novel_every=1, **sizes))
    return out


def fine_scenes(count: int = 15, real: str | None = None, times: int = 1) -> list[SceneRecipe]:
    """Streets at 320×180."""
    out = []
    if real is not None:
        pair = [SceneRecipe(real, max_points=18_000), SceneRecipe(real, max_points=36_000, distant_count=4_000)]
        out = times * pair
    return out + [SceneRecipe(_street(k * 37 % 900, k), max_points=FINE_POINTS[k % 4]) for k in range(count)]


def dense_scenes(count: int = 28, real: str | None = None, times: int = 1) -> list[SceneRecipe]:
    """Streets at 320×180 with up to as many Gaussians as the preset ``small`` has."""
    out = []
    if real is not None:
        out = times * [SceneRecipe(real, max_points=n, distant_count=n // 10) for n in DENSE_REAL_POINTS]
    for k in range(count):
        points = DENSE_POINTS[(k + k // 4) % 4]
        out.append(SceneRecipe(_street(k * 37 % 900, k), max_points=points, distant_count=points // 10))
    return out


def _planned(recipe: SceneRecipe, k: int) -> SceneRecipe:
    """With its plan, and on a street with the first none to four of the effects."""
    more = "".join(EFFECTS[: k % (len(EFFECTS) + 1)]) if recipe.uri.startswith("synthetic:") else ""
    return replace(recipe, uri=recipe.uri + more, planned=True)


def _street(seed: int, k: int, more: str = "") -> str:
    cameras = CAMERAS[k % len(CAMERAS)]
    return f"synthetic:street?seed={seed}{more}" + (f"&cameras={cameras}" if cameras != 3 else "")
