"""Nearest hits and shadows with Embree: one scene for what stands, one for each rigid part of an actor.

Rays are turned into a moving part's own frame at the ray's own time, so nothing is rebuilt from frame to frame and a
LiDAR sweep sees every point of a moving car where it was when the beam met it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from genre_tasks.logs.synthetic.actors import Actor, Part
from genre_tasks.logs.synthetic.layout import Layout
from genre_tasks.logs.synthetic.mesh import Mesh, joined
from genre_tasks.logs.synthetic.noise import Reals, dot3, rotated
from genre_tasks.logs.types import Float32, Float64

_SHADOW_OFFSET_M = 0.01


@dataclass(frozen=True)
class Hits:
    """``distance_m`` [n] (inf: sky), ``face`` [n] into the scene's table (−1: sky), ``u``, ``v`` [n] barycentric,
    ``normal`` [n, 3] unit, towards the ray's origin."""

    distance_m: Float32
    face: NDArray[np.int64]
    u: Float32
    v: Float32
    normal: Float32


@dataclass(frozen=True)
class _Moving:
    actor: Actor
    part: Part
    scene: object
    first_face: int
    centre: Float64
    radius: float

    def world_SE3_part(self, times: Float64) -> Float64:
        """[n, 4, 4]."""
        pose = self.actor.world_SE3_actor(times)
        return pose if self.part.actor_SE3_part is None else pose @ self.part.actor_SE3_part(times)


def _embree(vertices: Float64) -> object:
    from embreex.mesh_construction import TriangleMesh
    from embreex.rtcore_scene import EmbreeScene

    scene = EmbreeScene()
    TriangleMesh(scene, np.ascontiguousarray(vertices, np.float32))
    return scene


def _face_normals(mesh: Mesh) -> Float32:
    a, b, c = (mesh.vertices[:, k] for k in range(3))
    n = np.cross(b - a, c - a)
    return (n / np.maximum(np.linalg.norm(n, axis=1, keepdims=True), 1e-12)).astype(np.float32)


class Scene:
    """The street as something to cast rays at; coordinates are the street's own (float32 suffices there)."""

    def __init__(self, layout: Layout) -> None:
        self._static = _embree(layout.static.vertices)
        self._moving: list[_Moving] = []
        meshes, first = [layout.static], len(layout.static)
        for actor in layout.actors:
            for part in actor.parts:
                corners = part.mesh.vertices.reshape(-1, 3)
                centre = (corners.min(0) + corners.max(0)) / 2
                radius = float(np.linalg.norm(corners - centre, axis=1).max()) + 0.02
                self._moving.append(_Moving(actor, part, _embree(part.mesh.vertices), first, centre, radius))
                meshes.append(part.mesh)
                first += len(part.mesh)
        self.faces = joined(meshes)
        self._normals = _face_normals(self.faces)

    def cast(
        self,
        origin: Float64,  # [3] or [n, 3]
        direction: Reals,  # [n, 3] unit
        time: float | Float64,  # seconds; one, or one a ray
        slack_m: float = 0.0,
    ) -> Hits:
        """Nearest hit of each ray. ``slack_m``: how far an actor may move within the spread of ``time``."""
        d = np.ascontiguousarray(direction, np.float32)
        o = np.ascontiguousarray(np.broadcast_to(origin, d.shape), np.float32)
        found = self._static.run(o, d, output=1)  # type: ignore[attr-defined]
        face = found["primID"].astype(np.int64)
        miss = face < 0
        distance = np.where(miss, np.float32(np.inf), found["tfar"])
        u, v = found["u"].copy(), found["v"].copy()
        normal = self._normals[np.where(miss, 0, face)]
        for m in self._moving:
            times = np.atleast_1d(np.asarray(time, float))
            middle = m.world_SE3_part(times[[len(times) // 2]])[0]
            pick = _near_sphere(origin, d, middle[:3, :3] @ m.centre + middle[:3, 3], m.radius + slack_m)
            if len(pick) == 0:
                continue
            pose = m.world_SE3_part(times if len(times) == 1 else times[pick])
            local_o = np.einsum("nji,nj->ni", pose[:, :3, :3], o[pick] - pose[:, :3, 3])
            local_d = np.einsum("nji,nj->ni", pose[:, :3, :3], d[pick].astype(float))
            part = m.scene.run(local_o.astype(np.float32), local_d.astype(np.float32), output=1)  # type: ignore[attr-defined]
            near = (part["primID"] >= 0) & (part["tfar"] < distance[pick])
            to = pick[near]
            distance[to], u[to], v[to] = part["tfar"][near], part["u"][near], part["v"][near]
            face[to] = part["primID"][near] + m.first_face
            rotation = np.broadcast_to(pose[:, :3, :3], (len(pick), 3, 3))[near]
            normal[to] = np.einsum("nij,nj->ni", rotation, self._normals[face[to]])
        np.multiply(normal, np.where(dot3(normal, d) > 0, np.float32(-1), np.float32(1))[:, None], out=normal)
        return Hits(distance, face, u, v, normal)

    def shadowed(self, points: Float32, normals: Float32, sun: Float64, time: float) -> NDArray[np.bool_]:
        """[n] whether something lies between each point and the sun (unit vector towards it)."""
        o = (points + normals * np.float32(_SHADOW_OFFSET_M)).astype(np.float32)
        d = np.broadcast_to(sun.astype(np.float32), o.shape).copy()
        dark = self._static.run(o, d, query="OCCLUDED") >= 0  # type: ignore[attr-defined]
        across = np.linalg.svd(sun[None])[2][1:]
        flat = o @ across.T.astype(np.float32)
        for m in self._moving:
            pose = m.world_SE3_part(np.array([time]))[0]
            centre = pose[:3, :3] @ m.centre + pose[:3, 3]
            off = flat - (across @ centre).astype(np.float32)
            pick = np.flatnonzero((off[:, 0] ** 2 + off[:, 1] ** 2 < m.radius**2) & ~dark)
            if len(pick) == 0:
                continue
            local_o = rotated(pose[:3, :3].T, o[pick] - pose[:3, 3])
            local_d = np.broadcast_to(sun @ pose[:3, :3], local_o.shape)
            hit = m.scene.run(local_o.astype(np.float32), local_d.astype(np.float32), query="OCCLUDED")  # type: ignore[attr-defined]
            dark[pick[hit >= 0]] = True
        return dark

    def texture_points(self, hits: Hits) -> Float32:
        """[n, 3] object coordinates of hits (``face`` must be valid)."""
        t = self.faces.texture[hits.face]
        u, v = hits.u[:, None], hits.v[:, None]
        return t[:, 0] * (1 - u - v) + t[:, 1] * u + t[:, 2] * v


def _near_sphere(origin: Float64, d: Float32, centre: Float64, radius: float) -> NDArray[np.int64]:
    """Rays that pass a sphere; a single origin ([3]) is much the faster."""
    to = (centre - origin).astype(np.float32)
    along = np.maximum(d @ to if to.ndim == 1 else dot3(to, d), 0)
    return np.flatnonzero(dot3(to, to) - along * along < radius**2)
