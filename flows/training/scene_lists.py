"""Lists of the scenes that training stages use: synthetic streets of three sizes, and a real log."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, Literal

from flows.training.training_scenes import SceneRecipe

CAMERA_COUNTS = (3, 3, 3, 6, 3, 3, 2, 3)
"""Cameras of the rig, street by street in turn."""

# In this order, since street k has the first k of them, in turn from none to all.
EFFECT_QUERIES = (
    "&rolling_shutter_s=0.02",
    "&distortion=0.02",
    "&exposure_jitter=0.2&white_balance_jitter=0.05",
    "&bonnet=0.08",
)
"""Effects that a street may have: 6 to 12 px of rolling shutter, 5 px of distortion, 15 % of exposure, a bonnet."""

COARSE_POINTS = (6_000, 8_000, 5_000, 10_000)
FINE_POINTS = (18_000, 20_000, 14_000, 24_000)
DENSE_POINTS = (18_000, 36_000, 14_000, 40_000)
DENSE_REAL_POINTS = (18_000, 36_000, 40_000)


@dataclass(frozen=True)
class SceneList:
    """Which scenes a training stage uses.

    Attributes:
        size: ``coarse`` (160 × 90 pixels), ``fine`` (320 × 180) or ``dense`` (as fine, with more Gaussians).
        count: how many synthetic streets.
        real: how often the real log's scenes come before them.
        rounds: how often the list is gone through. Scene k of the first round begins at the stage's start k, in
            turn, and each round moves the starts on by one.
        planned: scenes are as their plans of effects have them, and streets have up to four of
            :data:`EFFECT_QUERIES`.
    """

    size: Literal["coarse", "fine", "dense"]
    count: int
    real: int = 1
    rounds: int = 1
    planned: bool = False


def list_scene_recipes(scenes: SceneList, real: str | None) -> list[SceneRecipe]:
    """Lists one round of a stage's scenes.

    Args:
        scenes: which scenes.
        real: URI of a real log whose chunk 0 is trained on too, if any.

    Returns:
        The real log's scenes, then the streets.

    >>> [recipe.max_points for recipe in list_scene_recipes(SceneList("coarse", 3), None)]
    [6000, 8000, 5000]
    """
    if scenes.size == "coarse":
        return list_coarse_scenes(scenes.count, real, scenes.real)
    if scenes.size == "dense":
        recipes = list_dense_scenes(scenes.count, real, scenes.real)
        return [_with_effects(recipe, k) for k, recipe in enumerate(recipes)] if scenes.planned else recipes
    return list_fine_scenes(scenes.count, real, scenes.real)


def list_coarse_scenes(count: int = 40, real: str | None = None, times: int = 1) -> list[SceneRecipe]:
    """Lists scenes at 160 × 90 pixels: with a quarter of the pixels, four times as many steps take the same time.

    Args:
        count: how many streets.
        real: URI of a real log, if any.
        times: how often the real log's scenes come first.

    Returns:
        The scenes.
    """
    sizes: dict[str, Any] = {"distant_count": 800, "width_px": 160, "height_px": 90}
    recipes: list[SceneRecipe] = []
    if real is not None:
        dense = {**sizes, "distant_count": 1_500}
        pair = [SceneRecipe(real, max_points=6_000, **sizes), SceneRecipe(real, max_points=12_000, **dense)]
        # Twice as often as in the other lists, whose streets are fewer.
        recipes = 2 * times * pair
    for k in range(count):
        uri = _street_uri(_spread_seed(k, offset=11), k, "&width=160&height=90")
        recipes.append(SceneRecipe(uri, max_points=COARSE_POINTS[k % 4], novel_every=1, **sizes))
    return recipes


def list_fine_scenes(count: int = 15, real: str | None = None, times: int = 1) -> list[SceneRecipe]:
    """Lists scenes at 320 × 180 pixels.

    Args:
        count: how many streets.
        real: URI of a real log, if any.
        times: how often the real log's scenes come first.

    Returns:
        The scenes.
    """
    recipes: list[SceneRecipe] = []
    if real is not None:
        pair = [SceneRecipe(real, max_points=18_000), SceneRecipe(real, max_points=36_000, distant_count=4_000)]
        recipes = times * pair
    for k in range(count):
        recipes.append(SceneRecipe(_street_uri(_spread_seed(k), k), max_points=FINE_POINTS[k % 4]))
    return recipes


def list_dense_scenes(count: int = 28, real: str | None = None, times: int = 1) -> list[SceneRecipe]:
    """Lists scenes at 320 × 180 pixels with up to as many Gaussians as the preset ``small`` has.

    Args:
        count: how many streets.
        real: URI of a real log, if any.
        times: how often the real log's scenes come first.

    Returns:
        The scenes.
    """
    recipes: list[SceneRecipe] = []
    if real is not None:
        recipes = times * [SceneRecipe(real, max_points=n, distant_count=n // 10) for n in DENSE_REAL_POINTS]
    for k in range(count):
        # Moved on by one in every four, so that each number of points meets each rig of cameras.
        points = DENSE_POINTS[(k + k // 4) % 4]
        recipes.append(SceneRecipe(_street_uri(_spread_seed(k), k), max_points=points, distant_count=points // 10))
    return recipes


def _with_effects(recipe: SceneRecipe, k: int) -> SceneRecipe:
    """The scene with its plan; a street with the first none to four of the effects."""
    queries = "".join(EFFECT_QUERIES[: k % (len(EFFECT_QUERIES) + 1)]) if recipe.uri.startswith("synthetic:") else ""
    return replace(recipe, uri=recipe.uri + queries, planned=True)


def _spread_seed(k: int, offset: int = 0) -> int:
    # 37 has no factor in common with 900, so that all training seeds come before any comes again.
    return (k * 37 + offset) % 900


def _street_uri(seed: int, k: int, more: str = "") -> str:
    cameras = CAMERA_COUNTS[k % len(CAMERA_COUNTS)]
    # Three cameras are the default, which a URI leaves out: the URI is part of keys.
    return f"synthetic:street?seed={seed}{more}" + (f"&cameras={cameras}" if cameras != 3 else "")
