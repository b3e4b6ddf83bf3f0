"""The parts of scenes that edits take out and put in: the Gaussians of one actor with all that belongs to them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from genre_tasks.logs.types import Float64
from genre_tasks.scene.actor_node import ActorNode
from genre_tasks.scene.deformation import NODES, Deformation
from genre_tasks.scene.gaussians import Gaussians, map_attributes
from genre_tasks.scene.graph import FIRST_ACTOR, SH_COUNTS, SceneGraph
from genre_tasks.scene.rotations import quats_to_matrices

_MARGIN_M = 0.15
"""Boxes are annotated to some centimetres, and mirrors stick out of them."""

_REACH_SIGMAS = 2.0
"""A Gaussian is visible up to about so many standard deviations."""


@dataclass(frozen=True)
class ActorPart:
    """The Gaussians of an actor, in its box.

    Attributes:
        gaussians: M of them.
        spherical_harmonics: [M, K, 3] in the box, or none.
        deformation: of this actor alone, as number 0; ``None``: it is rigid.
        shadow_count: how many of the Gaussians are its contact shadow, the last ones.
    """

    gaussians: Gaussians
    spherical_harmonics: Tensor | None
    deformation: Deformation | None
    shadow_count: int = 0

    def __len__(self) -> int:
        return len(self.gaussians)


@dataclass(frozen=True)
class PlacedActor:
    """An actor of an edited scene.

    Attributes:
        node: its box and its new path, in chunk coordinates.
        shape_frames: [F] the moment of its recording whose shape it has at each frame of ``node``.
        deformation: how its shape changes over its recording, as number 0; ``None``: it is rigid.
        part: Gaussians that are added to the scene; ``None``: the actor has those that the scene has already.
        number: of the actor in the scene before the edit, whose Gaussians stay; ``None``: a new or changed one.
        keeps_shape: whether the deformation of the scene holds for it as it is.
    """

    node: ActorNode
    shape_frames: Float64
    deformation: Deformation | None = None
    part: ActorPart | None = None
    number: int | None = None
    keeps_shape: bool = True


def extract_part(scene: SceneGraph, number: int, shadow_count: int = 0) -> ActorPart:
    """Copies an actor out of a scene.

    Args:
        scene: any.
        number: of the actor in it.
        shadow_count: how many of its Gaussians are a contact shadow, the last ones, which are left out.

    Returns:
        Its Gaussians, harmonics and deformation.
    """
    rows = torch.nonzero(scene.nodes == FIRST_ACTOR + number)[:, 0]
    rows = rows[: len(rows) - shadow_count]
    harmonics = scene.spherical_harmonics
    return ActorPart(
        gaussians=map_attributes(lambda x: x.index_select(0, rows), scene.gaussians),
        spherical_harmonics=None if harmonics is None else harmonics.index_select(0, rows),
        deformation=select_deformation(scene.deformation, number),
    )


def select_deformation(deformation: Deformation | None, number: int) -> Deformation | None:
    """Selects the deformation of one actor.

    Args:
        deformation: of a scene.
        number: of the actor in the scene.

    Returns:
        With this actor alone, as number 0; ``None`` where it does not deform.
    """
    if deformation is None or number not in deformation.actors:
        return None
    row = deformation.actors.index(number)
    return Deformation(
        actors=(0,),
        sizes_m=deformation.sizes_m[row : row + 1],
        frames=deformation.frames,
        known=deformation.known[row : row + 1],
        offsets=deformation.offsets[row : row + 1],
    )


def assemble_edited_scene(scene: SceneGraph, placed: Sequence[PlacedActor]) -> SceneGraph:
    """Puts an edited scene together.

    What stays keeps its order, and what is new comes last. Gaussians of the same depth are drawn in their order, so
    that pixels without edited actors keep their bytes.

    Args:
        scene: before the edit.
        placed: all actors of the new scene, in their order; actors of ``scene`` that are not there are gone.

    Returns:
        The new scene.
    """
    nodes = torch.full((FIRST_ACTOR + len(scene.actors),), -1, dtype=torch.int64)
    nodes[:FIRST_ACTOR] = torch.arange(FIRST_ACTOR)
    for k, actor in enumerate(placed):
        if actor.number is not None:
            nodes[FIRST_ACTOR + actor.number] = FIRST_ACTOR + k
    new_nodes = nodes[scene.nodes]
    rows = torch.nonzero(new_nodes >= 0)[:, 0]
    added = [(k, actor.part) for k, actor in enumerate(placed) if actor.part is not None and len(actor.part)]
    parts = [part for _, part in added]
    gaussians = map_attributes(
        lambda x, *more: torch.cat([x.index_select(0, rows), *more]), scene.gaussians, *(p.gaussians for p in parts)
    )
    labels = [torch.full((len(part),), FIRST_ACTOR + k, dtype=torch.int64) for k, part in added]
    return replace(
        scene,
        gaussians=gaussians,
        nodes=torch.cat([new_nodes.index_select(0, rows), *labels]),
        actors=tuple(actor.node for actor in placed),
        deformation=_join_deformations(scene, placed),
        spherical_harmonics=_join_harmonics(scene, rows, parts),
    )


def trim_to_box(part: ActorPart, size_m: tuple[float, float, float]) -> ActorPart:
    """Trims an actor's Gaussians to its box, since what is outside of it explains pixels of the background.

    At its recorded place nothing shows that; where an actor is moved to, such Gaussians are smears around it.

    Args:
        part: the actor.
        size_m: length, width and height of its box.

    Returns:
        The actor without Gaussians whose centre is outside, and with smaller ones where they reached outside.
    """
    gaussians = part.gaussians
    half = torch.tensor(size_m, dtype=torch.float32) / 2 + _MARGIN_M
    room = half - gaussians.means.abs()
    # Widths along the axes of the box: the diagonal of R S Sᵀ Rᵀ.
    rotation = quats_to_matrices(gaussians.quats) if len(part) else torch.zeros(0, 3, 3)
    widths = _REACH_SIGMAS * (rotation * gaussians.log_scales.exp()[:, None]).square().sum(2).sqrt()
    inside = torch.nonzero((room > 0).all(1))[:, 0]
    shrink = (room / widths.clamp_min(1e-6)).amin(1).clamp(1e-3, 1.0).log()
    gaussians = replace(gaussians, log_scales=gaussians.log_scales + shrink[:, None])
    harmonics = part.spherical_harmonics
    return ActorPart(
        gaussians=map_attributes(lambda x: x.index_select(0, inside), gaussians),
        spherical_harmonics=None if harmonics is None else harmonics.index_select(0, inside),
        deformation=part.deformation,
    )


def add_shadow(part: ActorPart, shadow: Gaussians) -> ActorPart:
    """Adds a contact shadow to an actor, as its last Gaussians.

    Args:
        part: the actor, without a shadow.
        shadow: Gaussians in the same box, which look the same from all sides.
    """
    harmonics = part.spherical_harmonics
    if harmonics is not None:
        harmonics = torch.cat([harmonics, harmonics.new_zeros(len(shadow), *harmonics.shape[1:])])
    gaussians = map_attributes(lambda a, b: torch.cat([a, b]), part.gaussians, shadow)
    return ActorPart(gaussians, harmonics, part.deformation, len(shadow))


def _join_harmonics(scene: SceneGraph, rows: Tensor, parts: Sequence[ActorPart]) -> Tensor | None:
    harmonics = scene.spherical_harmonics
    counts = [h.shape[1] for h in (harmonics, *(p.spherical_harmonics for p in parts)) if h is not None]
    if not counts:
        return None
    # As many as the richest part has: the others' missing ones are 0.
    count = max(counts)
    base = harmonics if harmonics is not None else scene.gaussians.means.new_zeros(len(scene), count, 3)
    blocks = [base.index_select(0, rows)]
    for part in parts:
        zeros = part.gaussians.means.new_zeros(len(part), SH_COUNTS[1], 3)
        blocks.append(zeros if part.spherical_harmonics is None else part.spherical_harmonics)
    return torch.cat([torch.nn.functional.pad(b, (0, 0, 0, count - b.shape[1])) for b in blocks])


def _join_deformations(scene: SceneGraph, placed: Sequence[PlacedActor]) -> Deformation | None:
    kept: list[tuple[int, Deformation, dict[int, Tensor]]] = []
    for k, actor in enumerate(placed):
        own = actor.deformation
        if own is None:
            continue
        if actor.keeps_shape:
            known = {own.frames[f]: own.offsets[0, f] for f in np.flatnonzero(own.known[0])}
        else:
            at_moments = own.offsets_at([float(moment) for moment in actor.shape_frames])[:, 0]
            known = {int(frame): at_moments[f] for f, frame in enumerate(actor.node.frames)}
        kept.append((k, own, known))
    if not kept:
        return None
    frames = sorted(
        set(scene.deformation.frames if scene.deformation is not None else ()) | {f for *_, d in kept for f in d}
    )
    known_at = np.zeros((len(kept), len(frames)), bool)
    offsets = torch.zeros(len(kept), len(frames), NODES, 3)
    for row, (_, _, values) in enumerate(kept):
        for column, frame in enumerate(frames):
            if frame in values:
                known_at[row, column] = True
                offsets[row, column] = values[frame]
    sizes = torch.cat([deformation.sizes_m for _, deformation, _ in kept])
    return Deformation(tuple(k for k, *_ in kept), sizes, tuple(frames), known_at, offsets)
