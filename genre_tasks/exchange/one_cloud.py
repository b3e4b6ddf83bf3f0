"""For formats whose file is one cloud that rests: from the cloud to a scene, and back."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from genre_tasks.errors import InputError
from genre_tasks.exchange.types import ExchangeNode, ExchangeScene, SplatCloud

_NODE_NAME = "background"


def make_resting_scene(cloud: SplatCloud, losses: tuple[str, ...] = ()) -> ExchangeScene:
    """Makes a scene of one cloud that rests, as a file without nodes holds it.

    Args:
        cloud: any.
        losses: what of the file is not in the cloud.

    >>> make_resting_scene(SplatCloud.empty()).nodes[0].name
    'background'
    """
    return ExchangeScene((ExchangeNode(_NODE_NAME, cloud),), np.zeros(0), (), np.eye(4), losses)


def take_one_cloud(path: Path, scene: ExchangeScene) -> SplatCloud:
    """Takes the one cloud of a scene that is to be written into a file without nodes.

    Args:
        path: of the file, for the error.
        scene: with one node that rests, or with none.

    Returns:
        The node's cloud.

    Raises:
        InputError: the scene has several nodes, or its node moves.
    """
    if not scene.nodes:
        return SplatCloud.empty()
    if len(scene.nodes) > 1 or scene.nodes[0].motion is not None:
        problem = f"the file can hold one part that rests, and the scene has {len(scene.nodes)} parts"
        raise InputError(problem, remedy="Pose the scene at one moment, or choose glb or usdz.", file=path)
    return scene.nodes[0].cloud


def describe_one_cloud_losses(scene: ExchangeScene) -> tuple[str, ...]:
    """Lists what a file without nodes loses of any scene: parts, motion and the place in the world.

    Args:
        scene: to be written, posed at one moment or not.

    Returns:
        Sentences; empty where everything is kept.
    """
    losses = []
    moving = sum(node.motion is not None for node in scene.nodes)
    if moving:
        losses.append(f"The motion of {moving} {'actor' if moving == 1 else 'actors'} is left out.")
    if len(scene.nodes) > 1:
        losses.append(f"The {len(scene.nodes)} parts of the scene become one.")
    if not np.array_equal(scene.world_SE3_scene, np.eye(4)):
        losses.append("The scene's place in the world of its log is left out.")
    return tuple(losses)
