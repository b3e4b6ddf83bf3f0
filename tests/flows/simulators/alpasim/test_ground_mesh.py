"""The mesh of the ground: where it is, how it turns, and how large it may get."""

from __future__ import annotations

import io

import numpy as np
import pytest
from plyfile import PlyData

from flows.simulators.alpasim import ground_mesh
from flows.simulators.alpasim.ground_mesh import REACH_M, TRACK_REACH_M, build_ground_mesh, encode_mesh
from genre_tasks.scene_edits.ground import Ground


def make_slope() -> Ground:
    """A road that rises by a tenth along x."""
    x, y = (axis.ravel() for axis in np.meshgrid(np.arange(-60.0, 60.0), np.arange(-40.0, 40.0)))
    driven = np.arange(-60.0, 60.0, 5.0)
    return Ground(np.stack([x, y, 0.1 * x], 1), np.stack([driven, 0.0 * driven, 0.1 * driven], 1))


def test_heights_follow_the_road() -> None:
    mesh = build_ground_mesh(make_slope(), np.array([[-5.0, 0.0], [5.0, 0.0]]), step_m=4.0)
    assert mesh.vertices[:, 2] == pytest.approx(0.1 * mesh.vertices[:, 0], abs=0.1)


def test_normals_point_up_and_nothing_is_far_away() -> None:
    path = np.array([[0.0, 0.0], [10.0, 5.0]])
    tracks = np.array([[60.0, 0.0]])
    mesh = build_ground_mesh(make_slope(), path, tracks, step_m=2.0)
    edges = mesh.vertices[mesh.faces[:, 1:]] - mesh.vertices[mesh.faces[:, :1]]
    assert (np.cross(edges[:, 0], edges[:, 1])[:, 2] > 0).all()
    to_path = np.linalg.norm(mesh.vertices[:, None, :2] - path, axis=2).min(1)
    to_tracks = np.linalg.norm(mesh.vertices[:, None, :2] - tracks, axis=2).min(1)
    assert ((to_path < REACH_M) | (to_tracks < TRACK_REACH_M)).all()
    assert to_tracks.min() < 2.0


def test_a_long_path_has_a_wider_grid(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(ground_mesh, "MAX_VERTICES", 1000)
    flat = Ground(np.zeros((0, 3)), np.zeros((1, 3)))
    path = np.stack([np.linspace(0.0, 1000.0, 200), np.linspace(0.0, 1000.0, 200)], 1)
    assert 800 < len(build_ground_mesh(flat, path).vertices) < 1100


def test_the_file_has_triangles_of_single_precision() -> None:
    mesh = build_ground_mesh(make_slope(), np.zeros((1, 2)), step_m=5.0)
    ply = PlyData.read(io.BytesIO(encode_mesh(mesh)))
    assert [p.name for p in ply["vertex"].properties] == ["x", "y", "z"]
    assert ply["vertex"]["x"].dtype == np.float32
    assert np.stack(ply["face"]["vertex_indices"]).tolist() == mesh.faces.tolist()
