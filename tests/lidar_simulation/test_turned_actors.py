"""LiDAR on actors that edits turn or insert: beams meet the faces that images show, and no shadow."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from genre_tasks.config.simulation_sections import SimulateConfig
from genre_tasks.lidar_simulation.lidar_surfaces import LidarSurfaces
from genre_tasks.lidar_simulation.ray_casting import Rays, cast_rays, prepare_discs
from genre_tasks.logs.types import Float64
from genre_tasks.scene.chunk import Points
from genre_tasks.scene.graph import FIRST_ACTOR
from genre_tasks.scene_edits.chunk_scene import ChunkScene
from genre_tasks.scene_edits.edits import Insert, Move, Rotate
from tests.scene_edits.edited_runs import SIZE_M, MadeRun, edit, find_node


def scan_right_side() -> Points:
    """Points on the right side of a box, all that a LiDAR to its right meets."""
    x, z = (values.ravel() for values in np.meshgrid(np.arange(-1.9, 1.95, 0.1), np.arange(-0.7, 0.75, 0.1)))
    positions = np.stack([x, np.full(len(x), -SIZE_M[1] / 2), z], 1).astype(np.float32)
    count = len(positions)
    return Points(positions, np.full((count, 3), 90, np.uint8), np.ones(count, bool), np.zeros(count, np.int16))


class ScannedRun(MadeRun):
    """The made run with LiDAR points of car a, whose right side alone cameras and LiDAR see."""

    def load(self, number: int) -> ChunkScene:
        found = self._scenes[number]
        points = scan_right_side()
        actors = tuple(replace(a, points=points) if a.track_id == "a" else a for a in found.chunk.actors)
        return replace(found, chunk=replace(found.chunk, actors=actors))


def cast_at_left_side(chunk_scene: ChunkScene, track_id: str) -> tuple[Float64, Float64]:
    """Ranges [N] from 6 m to the left of an actor's middle, and those to its left face."""
    targets = np.array([[x, SIZE_M[1] / 2, z] for x in (-1.0, 0.0, 1.0) for z in (-0.3, 0.3)])
    origin = np.array([0.0, 6.0, 0.0])
    expected = np.linalg.norm(targets - origin, axis=1)
    box = find_node(chunk_scene, track_id).chunk_SE3_box[0]
    directions = (targets - origin) / expected[:, None] @ box[:3, :3].T
    origins = np.repeat((box[:3, :3] @ origin + box[:3, 3])[None], len(targets), axis=0)
    surfaces = LidarSurfaces(2000).build(chunk_scene)
    frame = int(find_node(chunk_scene, track_id).frames[0])
    with torch.no_grad():
        splats = surfaces.gaussians_at(frame).activate()
    discs = prepare_discs(splats, surfaces.nodes.numpy(), origins[0])
    return cast_rays(discs, Rays(origins, directions)).range_m, expected


@pytest.mark.parametrize(
    ("edits", "track_id"),
    [
        ((Rotate(actor="a", degrees=180),), "a"),
        ((Insert(actor="a", name="x", ahead_m=25, turn_deg=180, speed_m_s=0),), "x"),
    ],
)
def test_the_nearest_return_is_on_the_near_face(edits: tuple[object, ...], track_id: str) -> None:
    edited = edit(ScannedRun(), *edits).load(0)
    ranges, expected = cast_at_left_side(edited, track_id)
    assert ranges == pytest.approx(expected, abs=0.03)


def test_an_actor_that_is_not_turned_keeps_its_points() -> None:
    run = ScannedRun()
    edited = edit(run, Move(actor="a", forward_m=1.0)).load(0)
    assert np.array_equal(edited.chunk.actors[0].points.positions, scan_right_side().positions)


def test_no_beam_meets_a_contact_shadow() -> None:
    # Without points an actor's surfaces are its Gaussians, which the shadow is among.
    insert = Insert(actor="a", name="x", ahead_m=9, speed_m_s=0)
    counts = []
    for darkness in (0.0, 0.9):
        edited = edit(MadeRun(), insert, config=SimulateConfig(contact_shadow=darkness)).load(0)
        surfaces = LidarSurfaces(2000).build(edited)
        counts.append(int((surfaces.nodes == FIRST_ACTOR + 2).sum()))
    assert counts[0] == counts[1] > 0
