"""Scenes from glTF: Gaussians of all nodes, at rest or moved by an animation."""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from genre_tasks.errors import InputError
from genre_tasks.exchange.checks import check_finite_cloud
from genre_tasks.exchange.clouds import merge_clouds
from genre_tasks.exchange.gltf.accessors import AccessorReader
from genre_tasks.exchange.gltf.curves import PATH_WIDTHS, Curve, read_curve
from genre_tasks.exchange.gltf.document import Document, Node, pick
from genre_tasks.exchange.gltf.extras import NodeExtras, SceneExtras, parse_extras
from genre_tasks.exchange.gltf.placement import (
    GLTF_R_SCENE,
    apply_transform,
    compose_transforms,
    scale_cloud,
    split_motion,
)
from genre_tasks.exchange.gltf.splat_attributes import is_splats, read_primitive
from genre_tasks.exchange.moments import is_rising
from genre_tasks.exchange.types import ExchangeNode, ExchangeScene, NodeMotion, SplatCloud
from genre_tasks.logs.types import Float64

_REMEDY = "Export it again, or check it with a glTF validator."
_MATRIX_BYTES = 16 * 8
_UNFIT = re.compile(r"[^\w.-]+")
_LONGEST_NAME = 80


@dataclass(frozen=True)
class _PlacedNode:
    # A node that Gaussians may hang from, with what is between it and the scene.
    index: int
    transforms: Float64  # [F, 4, 4], or [1, 4, 4] where nothing above it or itself moves
    moves: bool


class SceneReader:
    """Reads the scene of one file.

    Args:
        path: of the file, for errors.
        document: its JSON.
        reader: of its arrays.
    """

    def __init__(self, path: Path, document: Document, reader: AccessorReader) -> None:
        self._path = path
        self._document = document
        self._reader = reader
        self._losses: dict[str, None] = {}
        self._curves = self._read_curves()
        starts = [curve.times_s for curves in self._curves.values() for curve in curves.values()]
        # Every moment at which anything has a keyframe.
        self._times_s: Float64 = np.unique(np.concatenate(starts)) if starts else np.zeros(0)

    def read(self) -> ExchangeScene:
        """Reads the scene.

        Returns:
            A node for each one of the file that has Gaussians.

        Raises:
            InputError: nodes form a circle, have several parents or no finite place, moments do not rise, or an array
                is not sound.
        """
        names: set[str] = set()
        nodes = []
        for placed in self._walk():
            node = self._read_node(placed)
            if node is not None:
                nodes.append(replace(node, name=_make_name(node.name, placed.index, names)))
        extras = parse_extras(self._path, self._document.asset.extras, SceneExtras)
        return self._finish(tuple(nodes), extras or SceneExtras(times_s=self._times_s.tolist()))

    def _finish(self, nodes: tuple[ExchangeNode, ...], extras: SceneExtras) -> ExchangeScene:
        # Moments of the extras are those of the keyframes before these were rounded.
        stated = np.asarray(extras.times_s, np.float64)
        times = self._times_s
        if any(node.motion is not None for node in nodes):
            agree = len(stated) == len(times) and np.array_equal(stated.astype(np.float32), times.astype(np.float32))
            times = stated if agree else times
        else:
            times = stated if not len(self._times_s) else np.zeros(0)
        if not is_rising(times):
            raise InputError("the moments of the file do not rise", remedy=_REMEDY, file=self._path)
        if extras.frames and len(extras.frames) != len(times):
            problem = f"the file names {len(extras.frames)} log frames for {len(times)} moments"
            raise InputError(problem, remedy=_REMEDY, file=self._path)
        return ExchangeScene(
            nodes=nodes,
            times_s=times,
            frames=tuple(extras.frames),
            world_SE3_scene=np.array(extras.world_SE3_scene, np.float64).reshape(4, 4),
            losses=tuple(dict.fromkeys((*extras.losses, *self._losses))),
        )

    def _read_curves(self) -> dict[int, dict[str, Curve]]:
        """Of each moving node, by what moves."""
        document = self._document
        curves: dict[int, dict[str, Curve]] = {}
        if len(document.animations) > 1:
            self._losses["The file has several animations, and the first one is read."] = None
        for animation in document.animations[:1]:
            for channel in animation.channels:
                target = channel.target
                if target.path not in PATH_WIDTHS or target.node is None:
                    self._losses["What the file animates beside places and sizes of nodes is not read."] = None
                    continue
                node = pick(self._path, document.nodes, target.node, "node")
                moved = curves.setdefault(target.node, {})
                if target.path in moved or node.matrix is not None:
                    problem = f"node {target.node} of the file is moved twice, or has a matrix"
                    raise InputError(problem, remedy=_REMEDY, file=self._path)
                sampler = pick(self._path, animation.samplers, channel.sampler, "sampler")
                moved[target.path] = read_curve(self._path, sampler, target.path, self._reader)
        return curves

    def _walk(self) -> Iterator[_PlacedNode]:
        """All nodes of the scene, parents first."""
        to_scene = np.eye(4)
        to_scene[:3, :3] = GLTF_R_SCENE.T
        nodes = self._document.nodes
        stack = [(index, to_scene[None], False) for index in reversed(self._find_roots())]
        reached: set[int] = set()
        while stack:
            index, above, parent_moves = stack.pop()
            node = pick(self._path, nodes, index, "node")
            if index in reached:
                problem = f"node {index} of the file has several parents, or is below itself"
                raise InputError(problem, remedy=_REMEDY, file=self._path)
            reached.add(index)
            if node.is_hidden:
                self._losses["Hidden nodes of the file are not read."] = None
                continue
            moves = parent_moves or index in self._curves
            # Counted before they are made: many nodes at many moments are much more than their text.
            self._reader.charge(_MATRIX_BYTES * (len(self._times_s) if moves else 1))
            with np.errstate(over="ignore", invalid="ignore"):
                transforms = above @ self._place(index, node)
            yield _PlacedNode(index, transforms, moves)
            stack += [(child, transforms, moves) for child in reversed(node.children)]

    def _find_roots(self) -> list[int]:
        document = self._document
        if document.scenes:
            scene = pick(self._path, document.scenes, document.scene or 0, "scene")
            if len(document.scenes) > 1:
                self._losses["The file has several scenes, and one is read."] = None
            return list(scene.nodes)
        children = {child for node in document.nodes for child in node.children}
        return [k for k in range(len(document.nodes)) if k not in children]

    def _place(self, index: int, node: Node) -> Float64:
        """A node's transforms [F or 1, 4, 4] below its parent."""
        if node.matrix is not None:
            # glTF states matrices column by column.
            matrix = np.array(node.matrix).reshape(4, 4).T
            if not np.array_equal(matrix[3], [0, 0, 0, 1]):
                raise InputError(f"node {index} of the file is no affine map", remedy=_REMEDY, file=self._path)
            return matrix[None]
        curves = self._curves.get(index, {})
        parts = {}
        for moved in PATH_WIDTHS:
            if moved in curves:
                parts[moved] = curves[moved].evaluate(self._times_s)
            else:
                count = len(self._times_s) if curves else 1
                parts[moved] = np.tile(np.array(getattr(node, moved), np.float64), (count, 1))
        if not parts["rotation"].any(1).all():
            raise InputError(
                f"node {index} of the file has a rotation without direction", remedy=_REMEDY, file=self._path
            )
        return compose_transforms(**parts)

    def _read_node(self, placed: _PlacedNode) -> ExchangeNode | None:
        """A node's Gaussians; ``None`` where it has none."""
        node = self._document.nodes[placed.index]
        extras = parse_extras(self._path, node.extras, NodeExtras)
        cloud = self._read_cloud(node, extras)
        if cloud is None:
            return None
        motion = None
        if placed.moves:
            split = split_motion(self._path, placed.transforms)
            if split.scale_changes:
                self._losses["Moving nodes change their size, and have that of their first moment."] = None
            cloud = scale_cloud(cloud, split.scale)
            motion = NodeMotion(split.scene_SE3_node, split.present)
        else:
            cloud = apply_transform(self._path, cloud, placed.transforms[0])
        check_finite_cloud(self._path, cloud)
        words = extras or NodeExtras()
        return ExchangeNode(
            name=node.name,
            cloud=replace(cloud, antialiased=words.antialiased),
            motion=motion,
            label=words.label,
            track_id=words.track_id,
            size_m=(words.size_m[0], words.size_m[1], words.size_m[2]),
        )

    def _read_cloud(self, node: Node, extras: NodeExtras | None) -> SplatCloud | None:
        if node.mesh is None:
            # A part without Gaussians has no mesh, since glTF has no empty ones.
            return None if extras is None else SplatCloud.empty(extras.sh_degree)
        clouds = []
        for primitive in pick(self._path, self._document.meshes, node.mesh, "mesh").primitives:
            if is_splats(primitive):
                cloud, losses = read_primitive(self._path, primitive, self._reader)
                clouds.append(cloud)
                self._losses |= dict.fromkeys(losses)
            else:
                self._losses["Surfaces and points of the file that are no Gaussians are not read."] = None
        return merge_clouds(clouds) if clouds else None


def _make_name(name: str, index: int, taken: set[str]) -> str:
    """A name that is fit for a file's, and that no other node has."""
    fit = _UNFIT.sub("-", name)[:_LONGEST_NAME].strip("-.") or f"node-{index}"
    # The index is the node's alone, so one more of them is always free in the end.
    while fit in taken:
        fit = f"{fit}-{index}"
    taken.add(fit)
    return fit
