"""Scenes as glTF: a node for each part, and one animation that moves the actors."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from genre_tasks.errors import InputError
from genre_tasks.exchange.gltf.accessors import BufferBuilder
from genre_tasks.exchange.gltf.binary_container import write_container
from genre_tasks.exchange.gltf.document import SPLATTING
from genre_tasks.exchange.gltf.extras import describe_node, describe_scene
from genre_tasks.exchange.gltf.placement import ROOT_ROTATION
from genre_tasks.exchange.gltf.splat_attributes import MOST_SH_DEGREE, add_primitive
from genre_tasks.exchange.types import ExchangeNode, ExchangeScene, NodeMotion

ROOT_NAME = "scene"
"""Name of the node that turns z up into y up."""

_FIRST_PART = 1


class SceneWriter:
    """Collects the JSON and the arrays of one file.

    Args:
        path: of the file.
        scene: to be written, of finite values.
    """

    def __init__(self, path: Path, scene: ExchangeScene) -> None:
        self._path = path
        self._scene = scene
        self._builder = BufferBuilder()
        self._meshes: list[dict[str, Any]] = []
        self._channels: list[dict[str, Any]] = []
        self._samplers: list[dict[str, Any]] = []
        # Times of keyframes by their moments: actors that are there throughout share one array.
        self._times: dict[bytes, int] = {}

    def write(self) -> None:
        """Writes the file.

        Raises:
            InputError: a value does not fit into float32, moments do not rise as float32, or the file would be larger
                than GLB can be.
        """
        parts = [self._describe_part(k, node) for k, node in enumerate(self._scene.nodes, start=_FIRST_PART)]
        root: dict[str, Any] = {"name": ROOT_NAME, "rotation": list(ROOT_ROTATION)}
        if parts:
            root["children"] = list(range(_FIRST_PART, _FIRST_PART + len(parts)))
        document: dict[str, Any] = {
            "asset": {"version": "2.0", "generator": "GenRe", "extras": describe_scene(self._scene)},
            "scene": 0,
            "scenes": [{"nodes": [0]}],
            "nodes": [root, *parts],
        }
        # glTF knows no empty lists.
        if self._meshes:
            document["extensionsUsed"] = [SPLATTING]
            document["meshes"] = self._meshes
        if self._channels:
            document["animations"] = [{"name": "log", "channels": self._channels, "samplers": self._samplers}]
        if self._builder.accessors:
            document["accessors"] = self._builder.accessors
            document["bufferViews"] = self._builder.buffer_views
            document["buffers"] = [{"byteLength": self._builder.byte_length}]
        text = json.dumps(document, ensure_ascii=False, allow_nan=False, separators=(",", ":")).encode()
        write_container(self._path, text, self._builder.arrays, self._builder.byte_length)

    def _describe_part(self, index: int, node: ExchangeNode) -> dict[str, Any]:
        degree = min(node.cloud.sh_degree, MOST_SH_DEGREE)
        part: dict[str, Any] = {"name": node.name, "extras": describe_node(node, degree)}
        if len(node.cloud):
            part["mesh"] = len(self._meshes)
            primitive = add_primitive(self._path, node.cloud, self._builder)
            self._meshes.append({"name": node.name, "primitives": [primitive]})
        if node.motion is not None:
            part |= self._animate(index, node.motion)
        return part

    def _animate(self, index: int, motion: NodeMotion) -> dict[str, Any]:
        """Adds a node's channels; gives its place at the first moment, for tools that play no animations."""
        present = motion.present
        part: dict[str, Any] = {}
        if present.any():
            poses = motion.scene_SE3_node[present]
            rotations = _make_continuous(Rotation.from_matrix(poses[:, :3, :3]).as_quat())
            translations = poses[:, :3, 3].astype(np.float32)
            # Keyframes are where the actor is there: those of an absent one would pull it towards the origin.
            times = self._add_times(np.flatnonzero(present))
            self._add_channel(index, "translation", times, translations, step=False)
            self._add_channel(index, "rotation", times, rotations, step=False)
            part = {"translation": translations[0].tolist(), "rotation": rotations[0].tolist()}
        if not present.all():
            # In glTF itself a scale of 0 hides a node, and every player knows scales. KHR_node_visibility says the
            # same, but is animated through another extension, which few players have.
            scales = np.repeat(present.astype(np.float32)[:, None], 3, axis=1)
            self._add_channel(index, "scale", self._add_times(np.arange(len(present))), scales, step=True)
            part["scale"] = scales[0].tolist()
        return part

    def _add_times(self, moments: NDArray[np.int64]) -> int:
        times = self._scene.times_s[moments].astype(np.float32)[:, None]
        if (np.diff(times[:, 0]) <= 0).any() or times[0, 0] < 0:
            problem = "the scene's moments do not rise from 0 on, or are too close for float32"
            raise InputError(problem, remedy="Write fewer moments.", file=self._path)
        key = times.tobytes()
        if key not in self._times:
            self._times[key] = self._builder.add(times, of_vertices=False, bounds=True)
        return self._times[key]

    def _add_channel(self, index: int, moved: str, times: int, values: NDArray[np.float32], *, step: bool) -> None:
        output = self._builder.add(values, of_vertices=False)
        self._channels.append({"sampler": len(self._samplers), "target": {"node": index, "path": moved}})
        self._samplers.append({"input": times, "output": output, "interpolation": "STEP" if step else "LINEAR"})


def _make_continuous(quats: NDArray[np.float64]) -> NDArray[np.float32]:
    """Chooses signs so that neighbours are near: some players do not look for the shorter arc."""
    flips = np.where((quats[1:] * quats[:-1]).sum(1) < 0, -1.0, 1.0)
    signs = np.concatenate([[1.0], np.cumprod(flips)])
    return (quats * signs[:, None]).astype(np.float32)
