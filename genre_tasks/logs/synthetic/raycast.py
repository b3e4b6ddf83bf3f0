"""Nearest hits and shadows with Embree: one scene for what stands, one for each rigid part of an actor.

Rays are turned into a moving part's own frame at the ray's own time, so nothing is rebuilt from frame to frame and a
LiDAR sweep sees every point of a moving car where it was when the beam met it. Coordinates are the street's own, in
which float32 suffices.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from genre_tasks.logs.synthetic.mesh import Mesh, join_meshes
from genre_tasks.logs.synthetic.noise import Reals, dot_rows, rotate
from genre_tasks.logs.synthetic.recent_values import RecentValues
from genre_tasks.logs.synthetic.street_actors import Actor, Part
from genre_tasks.logs.synthetic.street_layout import StreetLayout
from genre_tasks.logs.types import Float32, Float64

# A shadow ray starts so far above its face, or the face would shade itself.
_SHADOW_OFFSET_M = 0.01
_RADIUS_MARGIN_M = 0.02
# Some hundred parts at some ten moments.
_RECENT_POSES_BYTES = 1 << 18


@dataclass(frozen=True)
class Hits:
    """What n rays met first.

    Attributes:
        distance_m: [n] along the ray; inf: sky.
        face: [n] into ``RayCaster.faces``; -1: sky.
        u: [n] barycentric coordinate of the face's second vertex.
        v: [n] of its third vertex.
        normal: [n, 3] unit, towards the ray's origin.
    """

    distance_m: Float32
    face: NDArray[np.int64]
    u: Float32
    v: Float32
    normal: Float32

    def select(self, indices: NDArray[np.int64]) -> Hits:
        """Picks some of the rays.

        Args:
            indices: [m].

        Returns:
            m hits.
        """
        return Hits(
            self.distance_m[indices],
            self.face[indices],
            self.u[indices],
            self.v[indices],
            self.normal[indices],
        )


@dataclass(frozen=True)
class _MovingPart:
    """A part of an actor with its Embree scene, and a sphere around it in the part's own frame.

    Attributes:
        actor: to which the part belongs.
        part: the part.
        scene: Embree's.
        first_face: of the part in ``RayCaster.faces``.
        centre: [3] of the sphere, metres.
        radius: of the sphere.
    """

    actor: Actor
    part: Part
    scene: Any
    first_face: int
    centre: Float64
    radius: float

    def street_SE3_part(self, times: Float64) -> Float64:
        """Where the part is at times [n]: [n, 4, 4]."""
        return self.place(self.actor.street_SE3_actor(times), times)

    def place(self, street_SE3_actor: Float64, times: Float64) -> Float64:
        """Where the part is at times [n] of an actor with poses [n, 4, 4]: [n, 4, 4]."""
        if self.part.actor_SE3_part is None:
            return street_SE3_actor
        return street_SE3_actor @ self.part.actor_SE3_part(times)


def _build_embree_scene(vertices: Float64) -> Any:
    from embreex.mesh_construction import TriangleMesh
    from embreex.rtcore_scene import EmbreeScene

    scene = EmbreeScene()
    TriangleMesh(scene, np.ascontiguousarray(vertices, np.float32))
    return scene


def _face_normals(mesh: Mesh) -> Float32:
    """[T, 3] unit; a face without area has the normal 0."""
    a, b, c = np.moveaxis(mesh.vertices, 1, 0)
    normals = np.cross(b - a, c - a)
    return (normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)).astype(np.float32)


class RayCaster:
    """The street as something to cast rays at.

    Args:
        layout: the street.

    Attributes:
        faces: all faces, those of what stands first, in the order that ``Hits.face`` counts.
    """

    def __init__(self, layout: StreetLayout) -> None:
        self._static: Any = _build_embree_scene(layout.static.vertices)
        self._moving: list[_MovingPart] = []
        meshes = [layout.static]
        first_face = len(layout.static)
        for actor in layout.actors:
            for part in actor.parts:
                corners = part.mesh.vertices.reshape(-1, 3)
                # The sphere around the box is a little larger than the smallest one, and needs no search.
                centre = (corners.min(0) + corners.max(0)) / 2
                radius = float(np.linalg.norm(corners - centre, axis=1).max()) + _RADIUS_MARGIN_M
                scene = _build_embree_scene(part.mesh.vertices)
                self._moving.append(_MovingPart(actor, part, scene, first_face, centre=centre, radius=radius))
                meshes.append(part.mesh)
                first_face += len(part.mesh)
        self.faces = join_meshes(meshes)
        self._normals = _face_normals(self.faces)
        # The rays of an image's row and their shadows ask for the same moment, other threads for others.
        self._recent_poses: RecentValues[list[Float64]] = RecentValues(_RECENT_POSES_BYTES, _count_bytes)

    def cast(
        self,
        origin: Float64,  # [3] or [n, 3]
        direction: Reals,  # [n, 3]
        time: float | Float64,  # one, or [n]
        slack_m: float = 0.0,
    ) -> Hits:
        """Finds the nearest hit of each ray.

        Args:
            origin: [3] of all rays or [n, 3], metres.
            direction: [n, 3] unit.
            time: seconds since the first frame, of all rays or [n].
            slack_m: how far an actor may move within the spread of ``time``.

        Returns:
            n hits.
        """
        directions = np.ascontiguousarray(direction, np.float32)
        # Embree reads contiguous float32 alone.
        origins = np.ascontiguousarray(np.broadcast_to(origin, directions.shape), np.float32)
        found = self._static.run(origins, directions, output=1)
        face = found["primID"].astype(np.int64)
        is_miss = face < 0
        hits = Hits(
            distance_m=np.where(is_miss, np.float32(np.inf), found["tfar"]),
            face=face,
            u=found["u"].copy(),
            v=found["v"].copy(),
            normal=self._normals[np.where(is_miss, 0, face)],
        )
        times = np.atleast_1d(np.asarray(time, float))
        # One sphere for all rays of a sweep, at the middle of their times; the slack covers the rest.
        middle_poses = self._street_SE3_parts(float(times[len(times) // 2]))
        for moving, middle_pose in zip(self._moving, middle_poses, strict=True):
            centre = middle_pose[:3, :3] @ moving.centre + middle_pose[:3, 3]
            near = _find_rays_near_sphere(origin, directions, centre, moving.radius + slack_m)
            if len(near):
                pose = middle_pose[None] if len(times) == 1 else moving.street_SE3_part(times[near])
                self._add_nearer_hits(hits, moving, pose, origins, directions, near)
        # Faces have no outside: whichever side a ray meets is the one that is lit.
        facing_away = dot_rows(hits.normal, directions) > 0
        np.multiply(hits.normal, np.where(facing_away, np.float32(-1), np.float32(1))[:, None], out=hits.normal)
        return hits

    def _add_nearer_hits(
        self,
        hits: Hits,
        moving: _MovingPart,
        pose: Float64,  # [1, 4, 4] or [m, 4, 4] of the part
        origins: Float32,  # [n, 3]
        directions: Float32,  # [n, 3]
        near: NDArray[np.int64],  # [m] the rays that may meet the part
    ) -> None:
        """Replaces hits, in place, where a moving part is nearer."""
        # The transposed rotation turns world rays into the part's frame; distances along them stay.
        rotation = pose[:, :3, :3]
        local_origins = np.einsum("nji,nj->ni", rotation, origins[near] - pose[:, :3, 3])
        local_directions = np.einsum("nji,nj->ni", rotation, directions[near].astype(float))
        found = moving.scene.run(local_origins.astype(np.float32), local_directions.astype(np.float32), output=1)
        is_nearer = (found["primID"] >= 0) & (found["tfar"] < hits.distance_m[near])
        rays = near[is_nearer]
        hits.distance_m[rays] = found["tfar"][is_nearer]
        hits.u[rays] = found["u"][is_nearer]
        hits.v[rays] = found["v"][is_nearer]
        hits.face[rays] = found["primID"][is_nearer] + moving.first_face
        rotations = np.broadcast_to(rotation, (len(near), 3, 3))[is_nearer]
        hits.normal[rays] = np.einsum("nij,nj->ni", rotations, self._normals[hits.face[rays]])

    def _street_SE3_parts(self, time: float) -> list[Float64]:
        """Where every moving part is: [4, 4] each."""
        return self._recent_poses.get(time, lambda: self._pose_parts(time))

    def _pose_parts(self, time: float) -> list[Float64]:
        times = np.array([time])
        poses: list[Float64] = []
        actor: Actor | None = None
        for moving in self._moving:
            # The parts of an actor follow each other.
            if moving.actor is not actor:
                actor = moving.actor
                street_SE3_actor = actor.street_SE3_actor(times)
            poses.append(moving.place(street_SE3_actor, times)[0])
        return poses

    def find_shadowed(self, points: Float32, normals: Float32, sun: Float64, time: float) -> NDArray[np.bool_]:
        """Finds out which points lie in the shadow.

        Args:
            points: [n, 3] on faces, metres.
            normals: [n, 3] of the faces, on the side of the sun.
            sun: [3] unit vector towards the sun.
            time: seconds since the first frame.

        Returns:
            [n] whether something lies between each point and the sun.
        """
        origins = (points + normals * np.float32(_SHADOW_OFFSET_M)).astype(np.float32)
        directions = np.broadcast_to(sun.astype(np.float32), origins.shape).copy()
        is_dark: NDArray[np.bool_] = self._static.run(origins, directions, query="OCCLUDED") >= 0
        # On the plane across the sun's direction, all rays are points: a part can only shade those in its circle.
        plane_axes = np.linalg.svd(sun[None])[2][1:]
        on_plane = origins @ plane_axes.T.astype(np.float32)
        for moving, pose in zip(self._moving, self._street_SE3_parts(time), strict=True):
            centre = pose[:3, :3] @ moving.centre + pose[:3, 3]
            offset = on_plane - (plane_axes @ centre).astype(np.float32)
            is_near = offset[:, 0] ** 2 + offset[:, 1] ** 2 < moving.radius**2
            near = np.flatnonzero(is_near & ~is_dark)
            if len(near) == 0:
                continue
            local_origins = rotate(pose[:3, :3].T, origins[near] - pose[:3, 3]).astype(np.float32)
            local_directions = np.broadcast_to(sun @ pose[:3, :3], local_origins.shape).astype(np.float32)
            # Occlusion only: the first thing in the way ends the search.
            hit = moving.scene.run(local_origins, local_directions, query="OCCLUDED")
            is_dark[near[hit >= 0]] = True
        return is_dark

    def texture_coordinates(self, hits: Hits) -> Float32:
        """Interpolates the texture coordinates of faces.

        Args:
            hits: n hits of which none is sky.

        Returns:
            [n, 3] metres.
        """
        corners = self.faces.texture[hits.face]
        u = hits.u[:, None]
        v = hits.v[:, None]
        return corners[:, 0] * (1 - u - v) + corners[:, 1] * u + corners[:, 2] * v


def _count_bytes(poses: list[Float64]) -> int:
    return sum(pose.nbytes for pose in poses)


def _find_rays_near_sphere(origin: Float64, directions: Float32, centre: Float64, radius: float) -> NDArray[np.int64]:
    """The rays that pass a sphere, of n directions [n, 3] from one origin [3] or from n origins."""
    to_centre = (centre - origin).astype(np.float32)
    # From a single origin, one matrix product is much the faster.
    along = directions @ to_centre if to_centre.ndim == 1 else dot_rows(to_centre, directions)
    along = np.maximum(along, 0)
    return np.flatnonzero(dot_rows(to_centre, to_centre) - along * along < radius**2)
