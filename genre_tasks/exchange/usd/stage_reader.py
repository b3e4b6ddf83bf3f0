"""An OpenUSD stage as an exchange scene: a node for each field of Gaussians."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from pxr import Usd, UsdGeom

from genre_tasks.errors import InputError
from genre_tasks.exchange.types import ExchangeNode, ExchangeScene, NodeMotion, SplatCloud
from genre_tasks.exchange.usd import names
from genre_tasks.exchange.usd.particle_fields import is_field, read_cloud
from genre_tasks.exchange.usd.placement import place_cloud, scale_cloud, split_similarity
from genre_tasks.logs.types import Float64

_MAX_NODES = 10_000
_MAX_POSES = 2_000_000
"""Nodes times moments: a file may state a moment for one node that all others get a pose for."""

_Z_UP_FROM_Y_UP = np.array([[1.0, 0, 0, 0], [0, 0, -1, 0], [0, 1, 0, 0], [0, 0, 0, 1]])


def read_stage(stage: Any, file: Path) -> ExchangeScene:
    """Reads all fields of Gaussians that a stage shows.

    Args:
        stage: opened; its layers are checked.
        file: the file that the user named.

    Returns:
        The scene in metres with z up.

    Raises:
        InputError: there is no field, or one is damaged, or placed in a way that Gaussians cannot follow.
    """
    losses: list[str] = []
    prims = _find_fields(stage, file, losses)
    root = stage.GetDefaultPrim()
    is_ours = bool(root) and root.GetCustomDataByKey(names.VERSION) is not None
    codes = _find_codes(prims)
    times_s = np.array([(code - codes[0]) / stage.GetTimeCodesPerSecond() for code in codes])
    scene = ExchangeScene((), times_s, (), np.eye(4))
    if is_ours:
        scene = _read_scene_data(root, scene, file)
        codes = [float(time) * stage.GetTimeCodesPerSecond() for time in scene.times_s]
    if len(prims) * len(codes) > _MAX_POSES:
        raise _damage(f"the file moves {len(prims)} nodes at {len(codes)} moments", file)
    reader = _NodeReader(stage, codes, file)
    taken: set[str] = set()
    nodes = tuple(_with_free_name(reader.read(prim, losses), taken) for prim in prims)
    if not any(node.motion for node in nodes) and not is_ours:
        scene = replace(scene, times_s=np.zeros(0))
    return replace(scene, nodes=nodes, losses=(*scene.losses, *losses))


def _find_fields(stage: Any, file: Path, losses: list[str]) -> list[Any]:
    prims = []
    hidden = 0
    for prim in Usd.PrimRange(stage.GetPseudoRoot(), Usd.TraverseInstanceProxies()):
        if not is_field(prim):
            continue
        purpose = UsdGeom.Imageable(prim).ComputePurpose()
        if purpose in (UsdGeom.Tokens.proxy, UsdGeom.Tokens.guide):
            hidden += 1
            continue
        prims.append(prim)
        if len(prims) > _MAX_NODES:
            raise _damage(f"the file has more than {_MAX_NODES} fields of Gaussians", file)
    if hidden:
        losses.append(f"{hidden} fields of Gaussians are proxies or guides, which are not read.")
    if not prims:
        raise InputError(
            "the file has no field of Gaussians",
            remedy="Give one with prims of the type ParticleField3DGaussianSplat.",
            file=file,
        )
    return prims


def _find_codes(prims: list[Any]) -> list[float]:
    """All time codes at which a field or something above it is placed, shown or hidden."""
    codes: set[float] = set()
    visited = set()
    for prim in prims:
        above = prim
        while above and not above.IsPseudoRoot() and above.GetPath() not in visited:
            visited.add(above.GetPath())
            codes.update(UsdGeom.Xformable(above).GetTimeSamples() if above.IsA(UsdGeom.Xformable) else ())
            if above.IsA(UsdGeom.Imageable):
                codes.update(UsdGeom.Imageable(above).GetVisibilityAttr().GetTimeSamples())
            above = above.GetParent()
    return sorted(codes)


class _NodeReader:
    """Reads fields with their places.

    Args:
        stage: that they are on.
        codes: the time codes of the scene's moments.
        file: for errors.
    """

    def __init__(self, stage: Any, codes: list[float], file: Path) -> None:
        self._codes = codes
        self._file = file
        scale = UsdGeom.GetStageMetersPerUnit(stage)
        if not (np.isfinite(scale) and scale > 0):
            raise _damage(f"the stage has {scale} metres a unit", file)
        turned = _Z_UP_FROM_Y_UP if UsdGeom.GetStageUpAxis(stage) == UsdGeom.Tokens.y else np.eye(4)
        self._scene_from_stage: Float64 = turned @ np.diag([scale, scale, scale, 1.0])

    def read(self, prim: Any, losses: list[str]) -> ExchangeNode:
        """Reads a field.

        Args:
            prim: the field.
            losses: gets a sentence for what is not read.
        """
        cloud = read_cloud(prim, self._file, losses)
        node_prim = prim if prim.GetCustomDataByKey(names.NAME) is not None else prim.GetParent()
        name = node_prim.GetCustomDataByKey(names.NAME)
        antialiased = node_prim.GetCustomDataByKey(names.ANTIALIASED)
        cloud = replace(cloud, antialiased=antialiased if isinstance(antialiased, bool) else None)
        cloud, motion = self._place(prim, cloud, bool(node_prim.GetCustomDataByKey(names.MOVES)))
        if not isinstance(name, str) or not name:
            return ExchangeNode(_describe_path(prim), cloud, motion)
        size = node_prim.GetCustomDataByKey(names.SIZE_M)
        size_m = tuple(float(side) for side in size) if size is not None and len(size) == 3 else (0.0, 0.0, 0.0)
        if not np.isfinite(size_m).all():
            raise _damage(f"the size of '{name}' is not finite", self._file)
        return ExchangeNode(
            name=name,
            cloud=cloud,
            motion=motion,
            label=str(node_prim.GetCustomDataByKey(names.LABEL) or ""),
            track_id=str(node_prim.GetCustomDataByKey(names.TRACK_ID) or ""),
            size_m=size_m,  # type: ignore[arg-type]
        )

    def _place(self, prim: Any, cloud: SplatCloud, moves: bool) -> tuple[SplatCloud, NodeMotion | None]:
        codes = self._codes
        if not moves and not _is_time_varying(prim):
            matrix = self._place_at(prim, Usd.TimeCode.EarliestTime())
            return place_cloud(cloud, matrix, str(prim.GetPath()), self._file), None
        present = np.array([self._is_shown(prim, code) for code in codes], dtype=bool)
        poses = np.broadcast_to(np.eye(4), (len(codes), 4, 4)).copy()
        scales = []
        for row in np.flatnonzero(present):
            scale, pose = split_similarity(self._place_at(prim, codes[row]), str(prim.GetPath()), self._file)
            scales.append(scale)
            poses[row] = pose
        if scales and max(scales) - min(scales) > 1e-4 * max(scales):
            raise InputError(
                f"the node {prim.GetPath()} grows or shrinks over time",
                remedy="Gaussians of a node keep their size: give it one scale.",
                file=self._file,
            )
        return scale_cloud(cloud, float(np.median(scales)) if scales else 1.0), NodeMotion(poses, present)

    def _place_at(self, prim: Any, code: Any) -> Float64:
        matrix = UsdGeom.XformCache(code).GetLocalToWorldTransform(prim)
        # OpenUSD multiplies rows from the left.
        placed = self._scene_from_stage @ np.array(matrix, dtype=np.float64).T
        if not np.isfinite(placed).all():
            raise _damage(f"the place of {prim.GetPath()} is not finite", self._file)
        return placed

    @staticmethod
    def _is_shown(prim: Any, code: float) -> bool:
        return bool(UsdGeom.Imageable(prim).ComputeVisibility(code) != UsdGeom.Tokens.invisible)


def _is_time_varying(prim: Any) -> bool:
    while prim and not prim.IsPseudoRoot():
        if prim.IsA(UsdGeom.Xformable) and UsdGeom.Xformable(prim).TransformMightBeTimeVarying():
            return True
        if prim.IsA(UsdGeom.Imageable) and UsdGeom.Imageable(prim).GetVisibilityAttr().GetNumTimeSamples():
            return True
        prim = prim.GetParent()
    return False


def _read_scene_data(root: Any, scene: ExchangeScene, file: Path) -> ExchangeScene:
    times_s = np.array(root.GetCustomDataByKey(names.TIMES_S) or (), dtype=np.float64).reshape(-1)
    frames = tuple(int(frame) for frame in root.GetCustomDataByKey(names.FRAMES) or ())
    world = np.array(root.GetCustomDataByKey(names.WORLD_SE3_SCENE) or np.eye(4), dtype=np.float64)
    losses = tuple(str(loss) for loss in root.GetCustomDataByKey(names.LOSSES) or ())
    is_rising = np.isfinite(times_s).all() and bool((np.diff(times_s) > 0).all())
    if not is_rising or (frames and len(frames) != len(times_s)):
        raise _damage("the scene's times do not rise, or are not as many as its frames", file)
    if world.shape != (4, 4) or not np.isfinite(world).all():
        raise _damage("the scene's place in the world is no finite matrix", file)
    return replace(scene, times_s=times_s, frames=frames, world_SE3_scene=world.T.copy(), losses=losses)


def _describe_path(prim: Any) -> str:
    # A name fit for a file's name: identifiers hold letters, digits and underscores.
    return "-".join(str(part) for part in str(prim.GetPath()).strip("/").split("/"))


def _with_free_name(node: ExchangeNode, taken: set[str]) -> ExchangeNode:
    name = node.name
    number = 2
    while name in taken:
        name = f"{node.name}-{number}"
        number += 1
    taken.add(name)
    return replace(node, name=name)


def _damage(problem: str, file: Path) -> InputError:
    return InputError(problem, remedy="Export the scene again.", file=file)

