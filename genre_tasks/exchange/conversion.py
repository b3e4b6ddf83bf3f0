"""From scene graphs to what files hold, and back."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from genre_tasks.exchange.clouds import merge_clouds, transform_cloud, with_sh_degree
from genre_tasks.exchange.types import SH_DC, ExchangeNode, ExchangeScene, NodeMotion, SplatCloud
from genre_tasks.logs.types import Float32, Float64
from genre_tasks.scene.actor_node import ActorNode
from genre_tasks.scene.gaussians import Gaussians
from genre_tasks.scene.graph import DISTANT, FIRST_ACTOR, SH_COUNTS, STATIC, SceneGraph

BACKGROUND_NAME = "background"
"""Name of the node with the static part of a scene."""

DISTANT_NAME = "distant"
"""Name of the node with the far shell."""

RENDERED_SH_DEGREE = max(SH_COUNTS)
"""Highest degree of harmonics that a scene graph has."""

# A few actors are named in a sentence, and the rest are counted.
_LISTED = 5


def to_exchange_scene(
    scene: SceneGraph,
    frames: Sequence[int],
    times_s: Sequence[float],
    world_SE3_scene: Float64,
    *,
    names: Mapping[str, str],
    losses: Sequence[str] = (),
) -> ExchangeScene:
    """Takes a scene graph apart into what files hold.

    Args:
        scene: a chunk's.
        frames: [F] log frames that motions are stated at, in rising order.
        times_s: [F] seconds of these frames, on any clock.
        world_SE3_scene: [4, 4] float64 the chunk's place in the log's world.
        names: readable name of an actor by its track id, such as ``car-3``; an actor without one is ``actor-K``.
        losses: sentences on what the effects' plan has beyond a scene graph, such as exposure or a rolling shutter.

    Returns:
        A node ``background``, a node ``distant`` where the scene has a far shell, and one for each actor.

    Raises:
        ValueError: frames and times differ in number, or two nodes have one name.
    """
    if len(frames) != len(times_s):
        raise ValueError(f"expected one time for each frame, got {len(times_s)} times for {len(frames)} frames")
    owners = scene.nodes.cpu().numpy()
    cloud = _to_cloud(scene)
    nodes = [ExchangeNode(BACKGROUND_NAME, cloud.select(owners == STATIC))]
    if (owners == DISTANT).any():
        nodes.append(ExchangeNode(DISTANT_NAME, cloud.select(owners == DISTANT)))
    rotation, translation, present = scene.actor_poses(frames)
    for k, actor in enumerate(scene.actors):
        poses = np.broadcast_to(np.eye(4), (len(frames), 4, 4)).copy()
        poses[:, :3, :3] = rotation[:, k]
        poses[:, :3, 3] = translation[:, k]
        size = actor.size_m
        nodes.append(
            ExchangeNode(
                name=names.get(actor.track_id, f"actor-{k + 1}"),
                cloud=cloud.select(owners == FIRST_ACTOR + k),
                motion=NodeMotion(poses, present[:, k]),
                label=actor.label,
                track_id=actor.track_id,
                size_m=(float(size[0]), float(size[1]), float(size[2])),
            )
        )
    if len({node.name for node in nodes}) < len(nodes):
        raise ValueError(f"expected distinct names of nodes, got {[node.name for node in nodes]}")
    times = np.asarray(times_s, np.float64)
    return ExchangeScene(
        nodes=tuple(nodes),
        times_s=times - times[0] if len(times) else times,
        frames=tuple(int(frame) for frame in frames),
        world_SE3_scene=np.asarray(world_SE3_scene, np.float64),
        losses=(*_describe_deformation(scene, names), *losses),
    )


def _to_cloud(scene: SceneGraph) -> SplatCloud:
    """All Gaussians of a scene graph, each in its node's coordinates."""
    g = scene.gaussians
    harmonics = scene.spherical_harmonics
    return SplatCloud(
        means=_to_numpy(g.means),
        log_scales=_to_numpy(g.log_scales),
        quats=_to_numpy(g.quats),
        logit_opacities=_to_numpy(g.logit_opacities),
        # In float64 before it is rounded once, so that the colour comes back as near as float32 allows.
        sh_dc=((_to_numpy(g.colors).astype(np.float64) - 0.5) / SH_DC).astype(np.float32),
        sh_rest=np.zeros((len(scene), 0, 3), np.float32) if harmonics is None else _to_numpy(harmonics),
        antialiased=scene.antialiased,
    )


def _describe_deformation(scene: SceneGraph, names: Mapping[str, str]) -> tuple[str, ...]:
    if scene.deformation is None or not scene.deformation.actors:
        return ()
    bent = [names.get(scene.actors[k].track_id, f"actor-{k + 1}") for k in scene.deformation.actors]
    more = f" and {len(bent) - _LISTED} more" if len(bent) > _LISTED else ""
    return (f"The deformation of {', '.join(bent[:_LISTED])}{more} is left out: actors are rigid in the file.",)


def pose_scene(exchange: ExchangeScene, index: int | None) -> SplatCloud:
    """Poses all nodes at one moment and joins them.

    Args:
        exchange: with F moments.
        index: of the moment, 0 to F − 1; ``None``: the nodes that rest, without actors.

    Returns:
        Gaussians in the scene's coordinates, node by node; actors that are absent then are left out. Quaternions and
        spherical harmonics turn with their node.

    Raises:
        IndexError: there is no such moment.

    >>> resting = ExchangeScene((ExchangeNode("background", SplatCloud.empty()),), np.zeros(0), (), np.eye(4))
    >>> len(pose_scene(resting, None))
    0
    """
    if index is not None and not 0 <= index < len(exchange.times_s):
        raise IndexError(f"expected a moment below {len(exchange.times_s)}, got {index}")
    posed = []
    for node in exchange.nodes:
        if node.motion is None:
            posed.append(node.cloud)
        elif index is not None and node.motion.present[index]:
            posed.append(transform_cloud(node.cloud, node.motion.scene_SE3_node[index]))
    return merge_clouds(posed)


def limit_sh_degree(exchange: ExchangeScene, degree: int = RENDERED_SH_DEGREE) -> ExchangeScene:
    """Cuts spherical harmonics above a degree, and says so in the scene's losses.

    Args:
        exchange: any.
        degree: 0 to 4; by default the highest that is rendered.

    Returns:
        The scene itself where no node has a higher degree.
    """
    highest = max((node.cloud.sh_degree for node in exchange.nodes), default=0)
    if highest <= degree:
        return exchange
    cut = [
        replace(node, cloud=with_sh_degree(node.cloud, min(node.cloud.sh_degree, degree))) for node in exchange.nodes
    ]
    loss = f"Spherical harmonics of degree {highest} are cut to degree {degree}."
    return replace(exchange, nodes=tuple(cut), losses=(*exchange.losses, loss))


def to_scene_graph(exchange: ExchangeScene) -> SceneGraph:
    """Puts what a file holds together into a scene graph that can be rendered.

    Harmonics of degree 4 are cut to degree 3; :func:`limit_sh_degree`, called before, says so in the losses.

    Args:
        exchange: nodes that rest become the background, but for one named ``distant``; the others become actors.

    Returns:
        The scene graph in the scene's coordinates. Actors exist at log frames, or at 0, 1, 2, … where none is known.

    >>> resting = ExchangeScene((ExchangeNode("background", SplatCloud.empty()),), np.zeros(0), (), np.eye(4))
    >>> len(to_scene_graph(resting)), to_scene_graph(resting).actors
    (0, ())
    """
    exchange = limit_sh_degree(exchange)
    frames = np.asarray(exchange.frames or range(len(exchange.times_s)), np.int64)
    actors: list[ActorNode] = []
    owners = []
    for node in exchange.nodes:
        owner = DISTANT if node.name == DISTANT_NAME else STATIC
        if node.motion is not None:
            owner = FIRST_ACTOR + len(actors)
            present = node.motion.present
            poses = np.asarray(node.motion.scene_SE3_node, np.float64)[present]
            actors.append(ActorNode(node.track_id or node.name, node.label, node.size_m, frames[present], poses))
        owners.append(np.full(len(node.cloud), owner, np.int64))
    cloud = merge_clouds([node.cloud for node in exchange.nodes])
    gaussians = Gaussians(
        means=_to_tensor(cloud.means),
        log_scales=_to_tensor(cloud.log_scales),
        quats=_to_tensor(cloud.quats),
        logit_opacities=_to_tensor(cloud.logit_opacities),
        colors=_to_tensor((0.5 + SH_DC * cloud.sh_dc.astype(np.float64)).astype(np.float32)),
    )
    return SceneGraph(
        gaussians=gaussians,
        nodes=torch.from_numpy(np.concatenate(owners) if owners else np.zeros(0, np.int64)),
        actors=tuple(actors),
        antialiased=any(bool(node.cloud.antialiased) for node in exchange.nodes),
        spherical_harmonics=_to_tensor(cloud.sh_rest) if cloud.sh_degree else None,
    )


def _to_numpy(values: Tensor) -> Float32:
    return np.asarray(values.detach().cpu().float().numpy())


def _to_tensor(values: Float32) -> Tensor:
    # Copied where it must be: arrays of files may be read-only.
    return torch.from_numpy(np.require(values, np.float32, ["C", "W"]))
