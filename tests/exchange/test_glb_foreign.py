"""GLB files of other tools."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from genre_tasks.exchange.gltf.placement import GLTF_R_SCENE
from genre_tasks.exchange.sh_rotation import evaluate_real_sh
from genre_tasks.exchange.types import SplatCloud
from genre_tasks.srgb import linear_to_srgb
from tests.exchange.foreign_glb import check_refused, read_foreign
from tests.exchange.gltf_files import PREFIX, float_attributes, foreign_file, join_glb, play

SH_DC = 0.28209479177387814


def covariances(cloud: SplatCloud) -> NDArray[np.float64]:
    turn = Rotation.from_quat(np.roll(cloud.quats.astype(np.float64), -1, axis=1)).as_matrix()
    variance = np.exp(2 * cloud.log_scales.astype(np.float64))
    return np.asarray(turn @ (variance[:, :, None] * turn.transpose(0, 2, 1)))


def expected_covariances(attributes: dict[str, Any], linear: NDArray[np.float64]) -> NDArray[np.float64]:
    turn = linear @ Rotation.from_quat(attributes[f"{PREFIX}ROTATION"][0].astype(np.float64)).as_matrix()
    variance = attributes[f"{PREFIX}SCALE"][0].astype(np.float64) ** 2
    return np.asarray(turn @ (variance[:, :, None] * turn.transpose(0, 2, 1)))


def test_floats_are_turned_to_z_up(tmp_path: Path) -> None:
    attributes = float_attributes(sh_degree=3)
    scene = read_foreign(tmp_path, *foreign_file(attributes))
    cloud = scene.nodes[0].cloud
    np.testing.assert_allclose(cloud.means, attributes["POSITION"][0] @ GLTF_R_SCENE, atol=1e-6)
    np.testing.assert_allclose(covariances(cloud), expected_covariances(attributes, GLTF_R_SCENE.T), atol=1e-6)
    opacities = 1 / (1 + np.exp(-cloud.logit_opacities))
    np.testing.assert_allclose(opacities, attributes[f"{PREFIX}OPACITY"][0], atol=1e-6)
    np.testing.assert_array_equal(cloud.sh_dc, attributes[f"{PREFIX}SH_DEGREE_0_COEF_0"][0])
    direction = np.array([0.36, 0.48, -0.8])
    stored = np.stack([v[0] for name, v in attributes.items() if "SH_DEGREE" in name][1:], 1)
    before = np.einsum("k,nkc->nc", evaluate_real_sh(direction, 3), stored)
    after = np.einsum("k,nkc->nc", evaluate_real_sh(GLTF_R_SCENE.T @ direction, 3), cloud.sh_rest)
    np.testing.assert_allclose(after, before, atol=1e-5)
    assert scene.nodes[0].name == "node-0" and scene.losses == () and scene.frames == ()


@pytest.mark.parametrize("bits", [8, 16])
def test_whole_numbers(tmp_path: Path, bits: int) -> None:
    attributes = float_attributes()
    signed = np.dtype(f"<i{bits // 8}")
    unsigned = np.dtype(f"<u{bits // 8}")
    most = np.iinfo(signed).max
    for name, kind, factor in (("ROTATION", signed, most), ("OPACITY", unsigned, np.iinfo(unsigned).max)):
        values = attributes[PREFIX + name][0]
        attributes[PREFIX + name] = (np.rint(values * factor).astype(kind), True)
    # The smallest number of a signed type stands for -1 too.
    rotations = attributes[f"{PREFIX}ROTATION"][0]
    rotations[0] = [-most - 1, 0, 0, 0]
    attributes[f"{PREFIX}SCALE"] = (np.full((6, 3), 2, unsigned), False)
    cloud = read_foreign(tmp_path, *foreign_file(attributes)).nodes[0].cloud
    stored = attributes[f"{PREFIX}OPACITY"][0] / np.iinfo(unsigned).max
    np.testing.assert_allclose(1 / (1 + np.exp(-cloud.logit_opacities)), stored, atol=2e-6)
    np.testing.assert_allclose(cloud.log_scales, np.log(2.0), atol=1e-6)
    whole = {**attributes, f"{PREFIX}ROTATION": (np.maximum(rotations / most, -1), False)}
    np.testing.assert_allclose(covariances(cloud), expected_covariances(whole, GLTF_R_SCENE.T), atol=1e-4)


def test_normalized_scales_may_be_zero(tmp_path: Path) -> None:
    attributes = float_attributes()
    attributes[f"{PREFIX}SCALE"] = (np.tile(np.array([255, 51, 0], np.uint8), (6, 1)), True)
    cloud = read_foreign(tmp_path, *foreign_file(attributes, stride=24)).nodes[0].cloud
    np.testing.assert_allclose(cloud.log_scales[:, :2], np.tile(np.log([1.0, 0.2]), (6, 1)), atol=1e-6)
    assert np.isfinite(cloud.log_scales).all() and cloud.log_scales[0, 2] < -80


def test_padded_elements(tmp_path: Path) -> None:
    attributes = float_attributes(sh_degree=1)
    tight = read_foreign(tmp_path, *foreign_file(attributes)).nodes[0].cloud
    padded = read_foreign(tmp_path, *foreign_file(attributes, stride=20)).nodes[0].cloud
    np.testing.assert_array_equal(padded.means, tight.means)
    np.testing.assert_array_equal(padded.sh_rest, tight.sh_rest)


def test_sparse_arrays(tmp_path: Path) -> None:
    attributes = float_attributes()
    document, binary = foreign_file(attributes)
    start = len(binary)
    binary += np.array([1, 4], "<u2").tobytes() + np.array([[1, 2, 3], [4, 5, 6]], "<f4").tobytes()
    document["buffers"][0]["byteLength"] = len(binary)
    document["bufferViews"] += [
        {"buffer": 0, "byteOffset": start, "byteLength": 4},
        {"buffer": 0, "byteOffset": start + 4, "byteLength": 24},
    ]
    sparse = {"count": 2, "indices": {"bufferView": 5, "componentType": 5123}, "values": {"bufferView": 6}}
    document["accessors"][0]["sparse"] = sparse
    expected = attributes["POSITION"][0].copy()
    expected[[1, 4]] = [[1, 2, 3], [4, 5, 6]]
    found = read_foreign(tmp_path, document, binary).nodes[0].cloud.means
    np.testing.assert_allclose(found, expected @ GLTF_R_SCENE, atol=1e-6)
    # Without a view all that is not replaced is zero.
    del document["accessors"][0]["bufferView"]
    expected[[0, 2, 3, 5]] = 0
    found = read_foreign(tmp_path, document, binary).nodes[0].cloud.means
    np.testing.assert_allclose(found, expected @ GLTF_R_SCENE, atol=1e-6)
    binary = binary.replace(np.array([1, 4], "<u2").tobytes(), np.array([1, 6], "<u2").tobytes())
    check_refused(tmp_path, document, binary, "replaces elements it does not have")


def test_nodes_that_rest_are_placed(tmp_path: Path) -> None:
    attributes = float_attributes(sh_degree=2)
    document, binary = foreign_file(attributes)
    turn = Rotation.from_euler("xyz", [0.3, -0.7, 1.1])
    document["nodes"] = [
        {"name": "parent", "translation": [1, 2, 3], "scale": [2, 2, 2], "children": [1]},
        {"name": "a b/c", "mesh": 0, "rotation": turn.as_quat().tolist()},
    ]
    node = read_foreign(tmp_path, document, binary).nodes[0]
    linear = GLTF_R_SCENE.T @ (2 * turn.as_matrix())
    expected = attributes["POSITION"][0] @ linear.T + GLTF_R_SCENE.T @ [1, 2, 3]
    np.testing.assert_allclose(node.cloud.means, expected, atol=1e-5)
    np.testing.assert_allclose(covariances(node.cloud), expected_covariances(attributes, linear), atol=1e-5)
    assert node.name == "a-b-c"
    # Stretched unevenly, by a matrix that is stated column by column.
    stretch = np.diag([1.0, 3.0, 0.5])
    matrix = np.eye(4)
    matrix[:3, :3] = turn.as_matrix() @ stretch
    document["nodes"] = [{"mesh": 0, "matrix": matrix.T.ravel().tolist()}]
    cloud = read_foreign(tmp_path, document, binary).nodes[0].cloud
    linear = GLTF_R_SCENE.T @ matrix[:3, :3]
    np.testing.assert_allclose(cloud.means, attributes["POSITION"][0] @ linear.T, atol=1e-5)
    np.testing.assert_allclose(covariances(cloud), expected_covariances(attributes, linear), atol=1e-5)


def test_linear_colours_are_converted_and_stated(tmp_path: Path) -> None:
    attributes = float_attributes(sh_degree=1)
    name = f"{PREFIX}SH_DEGREE_0_COEF_0"
    attributes[name] = (((np.full((6, 3), 0.214041) - 0.5) / SH_DC).astype("<f4"), False)
    scene = read_foreign(tmp_path, *foreign_file(attributes, colorSpace="lin_rec709_display"))
    cloud = scene.nodes[0].cloud
    np.testing.assert_allclose(0.5 + SH_DC * cloud.sh_dc, 0.5, atol=1e-5)
    slope = (linear_to_srgb(0.2145) - linear_to_srgb(0.2135)) / 0.001
    stored = attributes[f"{PREFIX}SH_DEGREE_1_COEF_0"][0]
    # The harmonic along y is the one along z in a scene.
    np.testing.assert_allclose(-cloud.sh_rest[:, 1], stored * slope, rtol=1e-3)
    assert "linear light" in scene.losses[0]


def test_splines_and_moving_parents(tmp_path: Path) -> None:
    document, binary = foreign_file(float_attributes())
    start = len(binary)
    times = np.array([0.0, 1.0], "<f4")
    # Tangents of zero: half way at half the time, and 5/32 of the way after a quarter.
    spline = np.array([[0, 0, 0], [1, 0, 0], [0, 0, 0], [0, 0, 0], [3, 0, 0], [0, 0, 0]], "<f4")
    turn_times = np.array([0.0, 0.25, 1.0], "<f4")
    quarter = np.sqrt(0.5)
    turns = np.array([[0, 0, 0, 1], [0, quarter, 0, quarter], [0, quarter, 0, quarter]], "<f4")
    for values, kind in ((times, "SCALAR"), (spline, "VEC3"), (turn_times, "SCALAR"), (turns, "VEC4")):
        view = {"buffer": 0, "byteOffset": len(binary), "byteLength": values.nbytes}
        document["accessors"].append(
            {"bufferView": len(document["bufferViews"]), "componentType": 5126, "count": len(values), "type": kind}
        )
        document["bufferViews"].append(view)
        binary += values.tobytes()
    assert start < len(binary)
    document["buffers"][0]["byteLength"] = len(binary)
    document["nodes"] = [{"children": [1], "translation": [0, 5, 0]}, {"mesh": 0, "name": "cart"}]
    document["animations"] = [
        {
            "channels": [
                {"sampler": 0, "target": {"node": 1, "path": "translation"}},
                {"sampler": 1, "target": {"node": 0, "path": "rotation"}},
            ],
            "samplers": [
                {"input": 5, "output": 6, "interpolation": "CUBICSPLINE"},
                {"input": 7, "output": 8},
            ],
        }
    ]
    scene = read_foreign(tmp_path, document, binary)
    motion = scene.nodes[0].motion
    assert motion is not None and scene.times_s.tolist() == [0.0, 0.25, 1.0] and motion.present.all()
    way = np.array([1.0, 1 + 2 * 5 / 32, 3.0])
    # A quarter turn about y takes x to -z.
    expected = [[way[0], 5, 0], [0, 5, -way[1]], [0, 5, -way[2]]]
    np.testing.assert_allclose(motion.scene_SE3_node[:, :3, 3], expected @ GLTF_R_SCENE, atol=1e-6)


def test_what_is_no_gaussian_is_a_loss(tmp_path: Path) -> None:
    document, binary = foreign_file(float_attributes())
    document["meshes"][0]["primitives"].append({"attributes": {"POSITION": 0}, "mode": 0})
    scene = read_foreign(tmp_path, document, binary)
    assert len(scene.nodes[0].cloud) == 6
    assert scene.losses == ("Surfaces and points of the file that are no Gaussians are not read.",)


def test_hidden_nodes_are_a_loss(tmp_path: Path) -> None:
    document, binary = foreign_file(float_attributes())
    hidden = {"extensions": {"KHR_node_visibility": {"visible": False}}, "children": [2]}
    shown = {"mesh": 0, "name": "shown", "extensions": {"KHR_node_visibility": {"visible": True}}}
    document["nodes"] = [hidden, shown, {"mesh": 0, "name": "below"}]
    document["scenes"] = [{"nodes": [0, 1]}]
    document["extensionsRequired"] = ["KHR_node_visibility"]
    scene = read_foreign(tmp_path, document, binary)
    assert [node.name for node in scene.nodes] == ["shown"]
    assert scene.losses == ("Hidden nodes of the file are not read.",)


def test_names_become_distinct(tmp_path: Path) -> None:
    document, binary = foreign_file(float_attributes())
    document["nodes"] = [{"mesh": 0, "name": "car"}, {"mesh": 0, "name": "car"}, {"mesh": 0, "name": "../.."}]
    document["scenes"] = [{"nodes": [0, 1, 2]}]
    assert [node.name for node in read_foreign(tmp_path, document, binary).nodes] == ["car", "car-1", "node-2"]


def test_names_keep_letters_of_any_language(tmp_path: Path) -> None:
    document, binary = foreign_file(float_attributes())
    document["nodes"] = [{"mesh": 0, "name": "汽车 3"}, {"mesh": 0, "name": "Größe_2"}]
    document["scenes"] = [{"nodes": [0, 1]}]
    assert [node.name for node in read_foreign(tmp_path, document, binary).nodes] == ["汽车-3", "Größe_2"]


def test_the_tests_player_knows_the_turn_of_a_quaternion() -> None:
    quat = Rotation.from_euler("xyz", [0.3, -0.7, 1.1]).as_quat()
    document, binary = foreign_file(float_attributes())
    document["nodes"][0] |= {"name": "turned", "rotation": quat.tolist()}
    found = play(join_glb(document, binary), 0.0)["turned"]
    np.testing.assert_allclose(found[:3, :3], Rotation.from_quat(quat).as_matrix(), atol=1e-12)
