"""GLB files with KHR_gaussian_splatting, as they are written."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh

from genre_tasks.errors import InputError
from genre_tasks.exchange.cloud_errors import CloudErrors, compare_clouds
from genre_tasks.exchange.gltf.format import GLB
from genre_tasks.exchange.gltf.placement import GLTF_R_SCENE
from genre_tasks.exchange.one_cloud import make_resting_scene
from genre_tasks.exchange.types import ExchangeScene, NodeMotion, SplatCloud
from tests.exchange.format_suite import FormatSuite
from tests.exchange.gltf_files import PREFIX, join_glb, play, read_accessor, split_glb
from tests.exchange.splat_clouds import change_one, make_cloud, make_driving_scene


class TestGlb(FormatSuite):
    name = "glb"
    sh_degrees = (0, 1, 2, 3)
    tolerances = CloudErrors(means_m=0, log_scales=1e-6, angles_rad=1e-6, opacities=1e-6, colors=0, sh_rest=0)


def write(folder: Path, scene: ExchangeScene) -> bytes:
    GLB.write(folder / "scene.glb", scene)
    return (folder / "scene.glb").read_bytes()


# --- what stands in a file


def test_attributes_are_those_of_the_extension(tmp_path: Path) -> None:
    cloud = replace(make_cloud(30, 2), antialiased=True)
    document, binary = split_glb(write(tmp_path, make_resting_scene(cloud)))
    assert document["extensionsUsed"] == ["KHR_gaussian_splatting"]
    primitive = document["meshes"][0]["primitives"][0]
    extension = primitive["extensions"]["KHR_gaussian_splatting"]
    assert (primitive["mode"], extension["kernel"], extension["colorSpace"]) == (0, "ellipse", "srgb_rec709_display")
    values = {name: read_accessor(document, binary, k) for name, k in primitive["attributes"].items()}
    np.testing.assert_array_equal(values["POSITION"], cloud.means)
    np.testing.assert_allclose(values[f"{PREFIX}SCALE"], np.exp(cloud.log_scales), rtol=1e-6)
    np.testing.assert_allclose(values[f"{PREFIX}OPACITY"][:, 0], 1 / (1 + np.exp(-cloud.logit_opacities)), rtol=1e-5)
    unit = cloud.quats / np.linalg.norm(cloud.quats, axis=1, keepdims=True)
    np.testing.assert_allclose(values[f"{PREFIX}ROTATION"], unit[:, [1, 2, 3, 0]], atol=1e-6)
    np.testing.assert_array_equal(values[f"{PREFIX}SH_DEGREE_0_COEF_0"], cloud.sh_dc)
    order = [(1, 0), (1, 1), (1, 2), (2, 0), (2, 1), (2, 2), (2, 3), (2, 4)]
    for k, (degree, n) in enumerate(order):
        np.testing.assert_array_equal(values[f"{PREFIX}SH_DEGREE_{degree}_COEF_{n}"], cloud.sh_rest[:, k])
    assert f"{PREFIX}SH_DEGREE_3_COEF_0" not in values
    # Positions must state their bounds.
    accessor = document["accessors"][primitive["attributes"]["POSITION"]]
    np.testing.assert_array_equal(accessor["min"], cloud.means.min(0))
    np.testing.assert_array_equal(accessor["max"], cloud.means.max(0))


def test_points_have_linear_colours_for_other_tools(tmp_path: Path) -> None:
    cloud = change_one(make_cloud(3), "sh_dc", 0.0)
    document, binary = split_glb(write(tmp_path, make_resting_scene(change_one(cloud, "logit_opacities", 0.0))))
    index = document["meshes"][0]["primitives"][0]["attributes"]["COLOR_0"]
    assert document["accessors"][index]["normalized"] is True
    # Grey 0.5 of sRGB is 0.214 of light, and a logit of 0 is half opaque.
    assert read_accessor(document, binary, index)[1].tolist() == [55, 55, 55, 128]


def test_words_are_in_extras(tmp_path: Path) -> None:
    scene = make_driving_scene()
    document, _ = split_glb(write(tmp_path, scene))
    extras = document["asset"]["extras"]["genre"]
    assert extras["frames"] == list(scene.frames)
    assert extras["world_SE3_scene"] == scene.world_SE3_scene.ravel().tolist()
    car = next(node for node in document["nodes"] if node["name"] == "car-1")
    assert car["extras"]["genre"]["label"] == "Car"
    assert car["extras"]["genre"]["track_id"] == "track/7"
    assert car["extras"]["genre"]["size_m"] == [4.5, 1.8, 1.5]


def test_a_scene_of_nothing_is_a_file_without_arrays(tmp_path: Path) -> None:
    document, binary = split_glb(write(tmp_path, make_resting_scene(SplatCloud.empty())))
    assert binary == b""
    # glTF allows no empty lists.
    assert not [name for name, value in document.items() if value == []]


# --- motion, by a player that is not ours


def expected_place(scene: ExchangeScene, name: str, moment: int) -> np.ndarray:
    node = next(node for node in scene.nodes if node.name == name)
    gltf_SE3_scene = np.eye(4)
    gltf_SE3_scene[:3, :3] = GLTF_R_SCENE
    return gltf_SE3_scene @ (np.eye(4) if node.motion is None else node.motion.scene_SE3_node[moment])


def test_a_player_finds_actors_where_they_are(tmp_path: Path) -> None:
    scene = make_driving_scene(moments=8)
    data = write(tmp_path, scene)
    for moment in (0, 3, 7):
        found = play(data, float(np.float32(scene.times_s[moment])))
        for name in ("background", "distant", "car-1"):
            np.testing.assert_allclose(found[name], expected_place(scene, name, moment), atol=1e-5)
    # Up is y, ahead is z and left is x.
    ahead_left_up = play(data, 0.0)["background"] @ [1.0, 2.0, 3.0, 1.0]
    assert ahead_left_up.tolist() == [2.0, 3.0, 1.0, 1.0]


def test_a_player_finds_actors_between_moments(tmp_path: Path) -> None:
    scene = make_driving_scene(moments=8)
    found = play(write(tmp_path, scene), 0.25)["car-1"]
    motion = scene.nodes[2].motion
    assert motion is not None
    place = GLTF_R_SCENE @ [10 + 12 * 0.25, 0.0, 0.75]
    np.testing.assert_allclose(found[:3, 3], place, atol=1e-5)
    angle = 0.8 * 0.25
    ahead = GLTF_R_SCENE @ [np.cos(angle), np.sin(angle), 0.0]
    np.testing.assert_allclose(found[:3, 0], ahead, atol=1e-5)


def test_a_player_hides_absent_actors(tmp_path: Path) -> None:
    scene = make_driving_scene(moments=8)
    data = write(tmp_path, scene)
    for moment, time_s in enumerate(scene.times_s):
        found = play(data, float(np.float32(time_s)))["pedestrian-2"]
        if moment % 3 == 1:
            assert not found[:3, :3].any()
        else:
            np.testing.assert_allclose(found, expected_place(scene, "pedestrian-2", moment), atol=1e-5)


def test_an_actor_that_comes_later_is_hidden_without_a_player(tmp_path: Path) -> None:
    scene = make_driving_scene()
    present = np.array([False, False, True, True, False])
    motion = scene.nodes[3].motion
    assert motion is not None
    late = replace(scene.nodes[3], motion=NodeMotion(motion.scene_SE3_node, present))
    never = replace(late, name="never", motion=NodeMotion(motion.scene_SE3_node, np.zeros(5, bool)))
    document, _ = split_glb(write(tmp_path, replace(scene, nodes=(late, never))))
    assert [node["scale"] for node in document["nodes"][1:]] == [[0, 0, 0], [0, 0, 0]]
    found = GLB.read(tmp_path / "scene.glb")
    assert [node.motion.present.tolist() for node in found.nodes if node.motion] == [present.tolist(), [False] * 5]
    np.testing.assert_array_equal(found.times_s, scene.times_s)


def test_another_library_finds_the_nodes(tmp_path: Path) -> None:
    scene = make_driving_scene()
    write(tmp_path, scene)
    found = trimesh.load(tmp_path / "scene.glb")
    assert isinstance(found, trimesh.Scene)
    assert set(found.geometry) == {node.name for node in scene.nodes}
    for node in scene.nodes:
        place, name = found.graph.get(node.name)
        np.testing.assert_allclose(place, expected_place(scene, node.name, 0), atol=1e-5)
        np.testing.assert_array_equal(found.geometry[name].vertices, node.cloud.means)


# --- losses and refusals


def test_times_come_back_as_the_log_has_them(tmp_path: Path) -> None:
    scene = make_driving_scene(moments=7)
    write(tmp_path, scene)
    assert GLB.read(tmp_path / "scene.glb").times_s.tolist() == scene.times_s.tolist()


@pytest.mark.parametrize("times", [[0.0, 0.1, 0.1, 0.2, 0.3], [0.0, 1e9, 1e9 + 0.1, 2e9, 3e9]])
def test_moments_that_do_not_rise_are_refused(tmp_path: Path, times: list[float]) -> None:
    with pytest.raises(InputError, match="do not rise"):
        write(tmp_path, replace(make_driving_scene(), times_s=np.array(times)))


def test_the_fourth_degree_is_cut_and_stated(tmp_path: Path) -> None:
    scene = make_resting_scene(make_cloud(5, 4))
    assert GLB.describe_losses(scene) == ("Spherical harmonics of degree 4 are cut to degree 3.",)
    write(tmp_path, scene)
    found = GLB.read(tmp_path / "scene.glb").nodes[0].cloud
    np.testing.assert_array_equal(found.sh_rest, scene.nodes[0].cloud.sh_rest[:, :15])


def test_losses_of_before_come_back(tmp_path: Path) -> None:
    losses = ("Exposure is left out.", "Of the " + 2000 * "x")
    document, binary = split_glb(write(tmp_path, replace(make_driving_scene(), losses=losses)))
    found = GLB.read(tmp_path / "scene.glb").losses
    # A sentence may name parts of files, and be as long as these names are.
    assert found[0] == losses[0] and losses[1].startswith(found[1]) and len(found[1]) == 1000
    # Files of old have none, and what is lost by reading comes after what was lost before, without repeats.
    repeated = "Surfaces and points of the file that are no Gaussians are not read."
    document["meshes"][0]["primitives"].append({"attributes": {"POSITION": 0}, "mode": 0})
    for stated, expected in (
        ([losses[0], repeated], (losses[0], repeated)),
        ([losses[0]], (losses[0], repeated)),
        (None, (repeated,)),
    ):
        extras = document["asset"]["extras"]["genre"]
        extras["losses"] = stated
        if stated is None:
            del extras["losses"]
        (tmp_path / "changed.glb").write_bytes(join_glb(document, binary))
        assert GLB.read(tmp_path / "changed.glb").losses == expected


def test_long_labels_and_track_ids_are_cut_and_stated(tmp_path: Path) -> None:
    scene = make_driving_scene()
    assert not GLB.describe_losses(scene)
    for name in ("label", "track_id"):
        long = replace(scene.nodes[2], **{name: 500 * "ab" + "c"})  # type: ignore[arg-type]
        changed = replace(scene, nodes=(*scene.nodes[:2], long, scene.nodes[3]))
        assert GLB.describe_losses(changed) == ("Labels and track ids of actors are cut to 1000 characters.",)
        write(tmp_path, changed)
        found = GLB.read(tmp_path / "scene.glb").nodes[2]
        assert (found.label, found.track_id) == (long.label[:1000], long.track_id[:1000])


def test_a_file_of_four_gibibytes_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("genre_tasks.exchange.gltf.binary_container._MOST_BYTES", 1000)
    with pytest.raises(InputError, match="less than 4 GiB"):
        write(tmp_path, make_resting_scene(make_cloud(50)))
    assert not (tmp_path / "scene.glb").exists()


def test_a_file_without_our_extras_is_read_in_full(tmp_path: Path) -> None:
    scene = make_driving_scene(1)
    document, binary = split_glb(write(tmp_path, scene))
    del document["asset"]["extras"]
    for node in document["nodes"]:
        node.pop("extras", None)
    (tmp_path / "bare.glb").write_bytes(join_glb(document, binary))
    found = GLB.read(tmp_path / "bare.glb")
    assert found.frames == ()
    np.testing.assert_allclose(found.times_s, scene.times_s, atol=1e-7)
    for before, after in zip(scene.nodes, found.nodes, strict=True):
        assert not compare_clouds(before.cloud, after.cloud).exceed(TestGlb.tolerances)
        assert (after.name, after.label) == (before.name, "")
