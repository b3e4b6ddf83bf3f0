"""OpenUSD packages and layers."""

from __future__ import annotations

import json
import struct
import subprocess
import sys
import zipfile
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pxr import Gf, Usd, UsdGeom, UsdValidation, UsdVol, Vt
from scipy.spatial.transform import Rotation

from genre_tasks.errors import InputError
from genre_tasks.exchange.activations import logits_to_opacities
from genre_tasks.exchange.cloud_errors import CloudErrors, compare_clouds
from genre_tasks.exchange.types import NodeMotion
from genre_tasks.exchange.usd.format import USDZ
from genre_tasks.exchange.usd.stage_dump import ARRAYS_FILE, STAGE_FILE, dump_stage
from tests.exchange.format_suite import FormatSuite
from tests.exchange.splat_clouds import make_driving_scene


class TestUsd(FormatSuite):
    name = "usdz"
    tolerances = CloudErrors(0, 1e-6, 1e-6, 1e-6, 1e-6, 1e-6)


@pytest.fixture
def real_process() -> None:
    """Asks for the process of its own that reads a file."""


@pytest.fixture(autouse=True)
def read_in_this_process(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    """Hundreds of files are read here, and to start a process for each takes half a second."""

    def dump(layer: Path, folder: Path, file: Path) -> tuple[dict[str, Any], dict[str, Any]]:
        try:
            dump_stage(layer, folder, file.stat().st_size)
        except InputError as error:
            raise InputError(error.problem, remedy=error.remedy, file=file) from error
        with np.load(folder / ARRAYS_FILE) as arrays:
            return json.loads((folder / STAGE_FILE).read_text()), dict(arrays)

    if "real_process" not in request.fixturenames:
        monkeypatch.setattr("genre_tasks.exchange.usd.format.run_stage_dump", dump)


@pytest.fixture
def package(tmp_path: Path) -> Path:
    """A scene with actors, as a package."""
    path = tmp_path / "scene.usdz"
    USDZ.write(path, make_driving_scene(2))
    return path


def make_layer(path: Path, **arrays: object) -> Any:
    """A layer of two Gaussians, as another program writes it: y up, centimetres, no customData; its stage."""
    stage = Usd.Stage.CreateNew(str(path))
    UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.y)
    UsdGeom.SetStageMetersPerUnit(stage, 0.01)
    field = UsdVol.ParticleField3DGaussianSplat.Define(stage, "/World/splat").GetPrim()
    values: dict[str, object] = {
        "positions": [(100, 200, 300), (0, 0, 0)],
        "scales": [(10, 20, 30), (1, 1, 1)],
        "orientations": [Gf.Quatf(1, 0, 0, 0), Gf.Quatf(0, 1, 0, 0)],
        "opacities": [0.25, 0.5],
        "radiance:sphericalHarmonicsDegree": 0,
        "radiance:sphericalHarmonicsCoefficients": [(0.1, 0.2, 0.3), (0.4, 0.5, 0.6)],
    }
    for name, value in (values | arrays).items():
        if value is not None:
            assert field.GetAttribute(name).Set(value), name
    stage.GetRootLayer().Save()
    return stage


# --- what is written


def test_validators_of_openusd_find_nothing(package: Path) -> None:
    registry = UsdValidation.ValidationRegistry()
    context = UsdValidation.ValidationContext(registry.GetOrLoadAllValidators())
    stage = Usd.Stage.Open(str(package))
    assert [error.GetMessage() for error in context.Validate(stage)] == []
    # The validators look at such things: without a default prim there is an error.
    broken = Usd.Stage.Open(str(package))
    broken.GetRootLayer().defaultPrim = ""
    assert context.Validate(broken)


def test_the_package_is_aligned_and_not_compressed(package: Path) -> None:
    data = package.read_bytes()
    with zipfile.ZipFile(package) as archive:
        (member,) = archive.infolist()
    assert member.compress_type == zipfile.ZIP_STORED and member.filename == "scene.usdc"
    name_bytes, extra_bytes = struct.unpack("<HH", data[26:30])
    start = 30 + name_bytes + extra_bytes
    assert start % 64 == 0 and data[start : start + 8] == b"PXR-USDC"


def test_openusd_shows_actors_where_they_are(package: Path) -> None:
    scene = make_driving_scene()
    stage = Usd.Stage.Open(str(package))
    assert UsdGeom.GetStageUpAxis(stage) == "Z" and UsdGeom.GetStageMetersPerUnit(stage) == 1.0
    assert stage.GetTimeCodesPerSecond() == 10 and (stage.GetStartTimeCode(), stage.GetEndTimeCode()) == (0, 4)
    car = stage.GetPrimAtPath("/Scene/car_1/gaussians")
    motion = scene.nodes[2].motion
    assert motion is not None
    for moment in (0, 2, 4):
        matrix = np.array(UsdGeom.XformCache(moment).GetLocalToWorldTransform(car)).T
        np.testing.assert_allclose(matrix, motion.scene_SE3_node[moment], atol=1e-9)
    # Halfway it has gone half of the way and has turned half of the angle, without any shear.
    matrix = np.array(UsdGeom.XformCache(0.5).GetLocalToWorldTransform(car)).T
    np.testing.assert_allclose(matrix[:3, :3] @ matrix[:3, :3].T, np.eye(3), atol=1e-9)
    assert np.arctan2(matrix[1, 0], matrix[0, 0]) == pytest.approx(0.8 * 0.05)
    assert matrix[0, 3] == pytest.approx(10 + 12 * 0.05)
    walker = UsdGeom.Imageable(stage.GetPrimAtPath("/Scene/pedestrian_2/gaussians"))
    assert [walker.ComputeVisibility(t) for t in (0, 1, 2)] == ["inherited", "invisible", "inherited"]


def test_attributes_are_those_of_the_schema(package: Path) -> None:
    cloud = make_driving_scene(2).nodes[2].cloud
    stage = Usd.Stage.Open(str(package))
    field = UsdVol.ParticleField3DGaussianSplat(stage.GetPrimAtPath("/Scene/car_1/gaussians"))
    assert field.GetRadianceSphericalHarmonicsDegreeAttr().Get() == 2
    coefficients = np.array(field.GetRadianceSphericalHarmonicsCoefficientsAttr().Get()).reshape(len(cloud), 9, 3)
    np.testing.assert_array_equal(coefficients[:, 0], cloud.sh_dc)
    np.testing.assert_array_equal(coefficients[:, 1:], cloud.sh_rest)
    np.testing.assert_allclose(field.GetScalesAttr().Get(), np.exp(cloud.log_scales), rtol=1e-6)
    np.testing.assert_allclose(field.GetOpacitiesAttr().Get(), 1 / (1 + np.exp(-cloud.logit_opacities)), atol=1e-6)
    first = field.GetOrientationsAttr().Get()[0]
    unit = cloud.quats[0] / np.linalg.norm(cloud.quats[0])
    np.testing.assert_allclose([first.GetReal(), *first.GetImaginary()], unit, atol=1e-6)
    low, high = np.array(field.GetExtentAttr().Get())
    assert (low < cloud.means.min(0)).all() and (high > cloud.means.max(0)).all()


def test_the_degree_is_written_also_where_it_is_0(tmp_path: Path) -> None:
    path = tmp_path / "plain.usda"
    USDZ.write(path, make_driving_scene(0))
    assert path.read_text().count("sphericalHarmonicsDegree = 0") == 4


@pytest.mark.parametrize("seed", range(5))
def test_moments_at_any_distance_keep_their_poses(tmp_path: Path, seed: int) -> None:
    scene = make_driving_scene(moments=40)
    random = np.random.default_rng(seed)
    times = np.cumsum(random.uniform(0.01, 0.3, 40))
    times -= times[0]
    motions = [node.motion for node in scene.nodes]
    assert motions[3] is not None
    present = random.random(40) < 0.5
    poses = np.where(present[:, None, None], motions[3].scene_SE3_node, np.eye(4))
    walker = replace(scene.nodes[3], motion=NodeMotion(poses, present))
    USDZ.write(tmp_path / "scene.usda", replace(scene, nodes=(*scene.nodes[:3], walker), times_s=times))
    found = USDZ.read(tmp_path / "scene.usda")
    np.testing.assert_array_equal(found.times_s, times)
    for node, before in zip(found.nodes[2:], (motions[2], walker.motion), strict=True):
        assert node.motion is not None and before is not None
        np.testing.assert_array_equal(node.motion.present, before.present)
        np.testing.assert_allclose(node.motion.scene_SE3_node[present], before.scene_SE3_node[present], atol=1e-9)


def test_names_that_are_no_identifiers_are_kept_apart(tmp_path: Path) -> None:
    scene = make_driving_scene()
    nodes = tuple(
        replace(node, name=name) for node, name in zip(scene.nodes, ("a-1", "a.1", "a_1", "1 ä"), strict=True)
    )
    path = tmp_path / "scene.usdc"
    USDZ.write(path, replace(scene, nodes=nodes))
    assert [node.name for node in USDZ.read(path).nodes] == ["a-1", "a.1", "a_1", "1 ä"]


# --- files of other programs


@pytest.mark.parametrize("suffix", [".usda", ".usdc", ".usd"])
def test_a_foreign_layer_comes_in_metres_with_z_up(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"foreign{suffix}"
    make_layer(path)
    (node,) = USDZ.read(path).nodes
    assert node.name == "World-splat" and node.motion is None and node.cloud.antialiased is None
    # x stays, what was up along y is up along z, and what pointed to the viewer along z points away from y.
    np.testing.assert_allclose(node.cloud.means, [[1, -3, 2], [0, 0, 0]], atol=1e-6)
    np.testing.assert_allclose(np.exp(node.cloud.log_scales[0]), [0.1, 0.2, 0.3], rtol=1e-5)
    # The first Gaussian was not turned, so that now its own y is up.
    turned = Rotation.from_quat(np.roll(node.cloud.quats[0], -1)).as_matrix()
    np.testing.assert_allclose(turned @ [0, 1, 0], [0, 0, 1], atol=1e-6)
    np.testing.assert_allclose(logits_to_opacities(node.cloud.logit_opacities), [0.25, 0.5], atol=1e-6)
    np.testing.assert_allclose(node.cloud.sh_dc, [[0.1, 0.2, 0.3], [0.4, 0.5, 0.6]], atol=1e-7)


def test_half_precision_is_read(tmp_path: Path) -> None:
    halves = {
        "positions": None,
        "positionsh": [(1, 2, 3), (4, 5, 6)],
        "scales": None,
        "scalesh": [(10, 20, 30), (1, 1, 1)],
        "orientations": None,
        "orientationsh": [Gf.Quath(1, 0, 0, 0), Gf.Quath(0, 1, 0, 0)],
        "opacities": None,
        "opacitiesh": [0.25, 1.0],
        "radiance:sphericalHarmonicsCoefficients": None,
        "radiance:sphericalHarmonicsCoefficientsh": [(0.5, 0.25, 0.125), (0, 0, 0)],
    }
    make_layer(tmp_path / "half.usdc", **halves)
    cloud = USDZ.read(tmp_path / "half.usdc").nodes[0].cloud
    np.testing.assert_allclose(cloud.means, [[0.01, -0.03, 0.02], [0.04, -0.06, 0.05]], rtol=1e-3)
    np.testing.assert_allclose(cloud.sh_dc[0], [0.5, 0.25, 0.125])
    assert np.isfinite(cloud.logit_opacities).all()


def test_a_degree_that_is_not_stated_is_3_or_what_fits(tmp_path: Path) -> None:
    unstated = {"radiance:sphericalHarmonicsDegree": None}
    for count, degree in ((16, 3), (9, 2), (1, 0)):
        path = tmp_path / f"{count}.usdc"
        coefficients = [(0.1, 0.1, 0.1)] * (2 * count)
        make_layer(path, **unstated, **{"radiance:sphericalHarmonicsCoefficients": coefficients})
        assert USDZ.read(path).nodes[0].cloud.sh_degree == degree


def test_a_moving_foreign_node_keeps_its_time(tmp_path: Path) -> None:
    stage = make_layer(tmp_path / "moving.usda")
    stage.SetTimeCodesPerSecond(50)
    move = UsdGeom.Xformable(stage.GetPrimAtPath("/World/splat")).AddTranslateOp()
    UsdGeom.Xformable(stage.GetPrimAtPath("/World/splat")).AddScaleOp().Set(Gf.Vec3f(2))
    for code, x in ((100, 0.0), (125, 400.0)):
        move.Set(Gf.Vec3d(x, 0, 0), code)
    stage.GetRootLayer().Save()
    scene = USDZ.read(tmp_path / "moving.usda")
    np.testing.assert_allclose(scene.times_s, [0, 0.5])
    motion = scene.nodes[0].motion
    assert motion is not None and motion.present.all()
    np.testing.assert_allclose(motion.scene_SE3_node[1, :3, 3], [4, 0, 0], atol=1e-9)
    np.testing.assert_allclose(np.linalg.det(motion.scene_SE3_node[:, :3, :3]), 1)
    # Both scales are the Gaussians' own now.
    np.testing.assert_allclose(scene.nodes[0].cloud.means[0], [2, 4, 6], rtol=1e-6)


def test_layers_of_one_package_may_name_each_other(tmp_path: Path) -> None:
    make_layer(tmp_path / "gaussians.usdc")
    root = Usd.Stage.CreateNew(str(tmp_path / "default.usda"))
    UsdGeom.SetStageUpAxis(root, UsdGeom.Tokens.z)
    UsdGeom.SetStageMetersPerUnit(root, 1.0)
    root.DefinePrim("/World").GetReferences().AddReference("./gaussians.usdc", "/World")
    root.GetRootLayer().Save()
    write_zip(tmp_path / "two.usdz", {n: (tmp_path / n).read_bytes() for n in ("default.usda", "gaussians.usdc")})
    (node,) = USDZ.read(tmp_path / "two.usdz").nodes
    np.testing.assert_allclose(node.cloud.means[0], [100, 200, 300])
    # The same layers as files: one names another, which is not read.
    with pytest.raises(InputError, match=r"names another one, '\./gaussians\.usdc'"):
        USDZ.read(tmp_path / "default.usda")


# --- hostile files


def write_zip(path: Path, members: dict[str, bytes], method: int = zipfile.ZIP_STORED) -> None:
    """An archive with these members."""
    with zipfile.ZipFile(path, "w", method) as archive:
        for name, data in members.items():
            archive.writestr(name, data)


def test_members_outside_of_the_package_are_refused(tmp_path: Path) -> None:
    make_layer(tmp_path / "a.usdc")
    layer = (tmp_path / "a.usdc").read_bytes()
    path = tmp_path / "slip.usdz"
    for name in ("../b.usdc", "/tmp/b.usdc", "x/../../b.usdc", "..\\b.usdc", "C:b.usdc", "b\n.usdc"):
        write_zip(path, {"a.usdc": layer, name: layer})
        with pytest.raises(InputError, match="outside of the package"):
            USDZ.read(path)
    write_zip(path, {"a.usdc": layer}, zipfile.ZIP_DEFLATED)
    with pytest.raises(InputError, match="compressed or encrypted"):
        USDZ.read(path)
    write_zip(path, {"readme.txt": b"", "a.usdc": layer})
    with pytest.raises(InputError, match="first member is no layer"):
        USDZ.read(path)
    write_zip(path, {"a.usdc": layer, "A.usdc": layer})
    with pytest.raises(InputError, match="share one name"):
        USDZ.read(path)
    assert sorted(p.name for p in tmp_path.iterdir()) == ["a.usdc", "slip.usdz"]


def test_members_that_share_their_bytes_are_refused(tmp_path: Path) -> None:
    make_layer(tmp_path / "a.usdc")
    path = tmp_path / "bomb.usdz"
    write_zip(path, {"a.usdc": (tmp_path / "a.usdc").read_bytes()})
    # The directory's entry again and again, as an archive that unpacks to more than it is.
    data = path.read_bytes()
    start = data.index(b"PK\x01\x02")
    end = data.index(b"PK\x05\x06")
    entry = data[start:end]
    tail = bytearray(data[end:])
    tail[8:16] = struct.pack("<HHI", 9, 9, 9 * len(entry))
    path.write_bytes(data[:start] + entry * 9 + tail)
    with pytest.raises(InputError, match="more bytes than it has"):
        USDZ.read(path)


@pytest.mark.parametrize(
    "arc",
    [
        "references = @/etc/hostname@",
        "references = @../other.usda@",
        "payload = @other.usda@",
        "references = @other.usdz[scene.usdc]@",
        'variants = { string v = "a" }\n    prepend variantSets = "v"',
        "clips = { dictionary default = { asset[] assetPaths = [@other.usda@] } }",
    ],
)
def test_layers_that_name_other_files_are_refused(tmp_path: Path, arc: str) -> None:
    make_layer(tmp_path / "other.usda")
    body = 'variantSet "v" = { "a" ( references = @other.usda@ ) { } }' if "variants" in arc else ""
    (tmp_path / "names.usda").write_text(f'#usda 1.0\n\ndef Xform "A" (\n    {arc}\n)\n{{\n{body}\n}}\n')
    with pytest.raises(InputError, match=r"names another one|from other files") as caught:
        USDZ.read(tmp_path / "names.usda")
    assert caught.value.file == str(tmp_path / "names.usda")


def test_sublayers_outside_are_refused(tmp_path: Path) -> None:
    make_layer(tmp_path / "other.usda")
    (tmp_path / "names.usda").write_text("#usda 1.0\n(\n    subLayers = [@other.usda@]\n)\n")
    with pytest.raises(InputError, match="names another one"):
        USDZ.read(tmp_path / "names.usda")


def test_parts_that_multiply_are_refused(tmp_path: Path) -> None:
    # Each level has the one below twice: thirty levels would have a billion prims.
    twice = 'def "a" (references = </L{0}>) {{}}\ndef "b" (references = </L{0}>) {{}}\n'
    levels = [f'def Xform "L{k}"\n{{\n{twice.format(k - 1)}}}\n' for k in range(1, 31)]
    stage = make_layer(tmp_path / "base.usda")
    body = stage.GetRootLayer().ExportToString().replace('def "World"', 'def Xform "L0"')
    (tmp_path / "many.usda").write_text(body + "\n".join(levels))
    with pytest.raises(InputError, match="composes more than"):
        USDZ.read(tmp_path / "many.usda")


def test_fields_that_share_large_arrays_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "shared.usdc"
    stage = Usd.Stage.CreateNew(str(path))
    points = Vt.Vec3fArray.FromNumpy(np.zeros((200_000, 3), np.float32))
    for k in range(40):
        field = UsdVol.ParticleField3DGaussianSplat.Define(stage, f"/f{k}")
        field.CreatePositionsAttr(points)
        field.CreateScalesAttr(points)
    stage.GetRootLayer().Save()
    assert path.stat().st_size < 3 << 20
    with pytest.raises(InputError, match=r"above 0|more often than its size allows"):
        USDZ.read(path)


@pytest.mark.parametrize(
    ("arrays", "words"),
    [
        ({"positions": None}, "no positions"),
        ({"scales": None}, "no scales"),
        ({"scales": [(1, 1, 1)]}, "1 scales for 2 positions"),
        ({"orientations": [Gf.Quatf(1)] * 3}, "3 orientations for 2 positions"),
        ({"opacities": [0.5]}, "1 opacities for 2 positions"),
        ({"radiance:sphericalHarmonicsDegree": 1}, "2 coefficients for 2 positions, expected 8"),
        ({"radiance:sphericalHarmonicsDegree": 7}, "degree 7"),
        ({"radiance:sphericalHarmonicsDegree": -1}, "degree -1"),
        ({"positions": [(0, 0, float("nan")), (0, 0, 0)]}, "positions is not finite"),
        ({"scales": [(1, 1, float("inf")), (1, 1, 1)]}, "scales is not finite"),
        ({"scales": [(-3, 1, 1), (1, 1, 1)]}, "negative scales"),
        ({"scales": [(0, 1, 1), (1, 1, 1)]}, "not above 0"),
        ({"opacities": [0.5, 4.0]}, "outside of 0 to 1"),
    ],
)
def test_damaged_arrays_are_named(tmp_path: Path, arrays: dict[str, object], words: str) -> None:
    make_layer(tmp_path / "bad.usda", **arrays)
    with pytest.raises(InputError, match=words) as caught:
        USDZ.read(tmp_path / "bad.usda")
    assert caught.value.file == str(tmp_path / "bad.usda")


@pytest.mark.parametrize("scale", [(1, 1, 2), (1, 1, -1), (0, 0, 0)])
def test_places_that_gaussians_cannot_follow_are_refused(tmp_path: Path, scale: tuple[float, float, float]) -> None:
    stage = make_layer(tmp_path / "bad.usda")
    UsdGeom.Xformable(stage.GetPrimAtPath("/World/splat")).AddScaleOp().Set(Gf.Vec3f(*scale))
    stage.GetRootLayer().Save()
    with pytest.raises(InputError, match="sheared, mirrored or scaled unevenly"):
        USDZ.read(tmp_path / "bad.usda")


def test_a_file_without_gaussians_is_refused(tmp_path: Path) -> None:
    (tmp_path / "empty.usda").write_text('#usda 1.0\ndef Sphere "ball" {}\n')
    with pytest.raises(InputError, match="no field of Gaussians"):
        USDZ.read(tmp_path / "empty.usda")


def test_a_scene_with_broken_data_of_ours_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "scene.usda"
    USDZ.write(path, make_driving_scene())
    text = path.read_text()
    for before, after in (
        ("double[] timesS = [0,", "double[] timesS = [9,"),
        ("int64[] frames = [20, ", "int64[] frames = ["),
    ):
        assert before in text
        path.write_text(text.replace(before, after))
        with pytest.raises(InputError, match="do not rise"):
            USDZ.read(path)


# --- the process that reads


@pytest.mark.usefixtures("real_process")
def test_the_process_reads_and_passes_errors_on(package: Path, tmp_path: Path) -> None:
    found = USDZ.read(package)
    for before, after in zip(make_driving_scene(2).nodes, found.nodes, strict=True):
        assert (before.name, before.label, before.track_id) == (after.name, after.label, after.track_id)
        assert compare_clouds(before.cloud, after.cloud).opacities < 1e-6
    make_layer(tmp_path / "bad.usda", opacities=[0.5])
    (tmp_path / "other.usda").write_text("#usda 1.0\n(\n    subLayers = [@bad.usda@]\n)\n")
    (tmp_path / "torn.usda").write_text('#usda 1.0\ndef "A" {')
    for name, words in (("bad", "1 opacities for 2"), ("other", "names another one"), ("torn", "OpenUSD cannot read")):
        with pytest.raises(InputError, match=words) as caught:
            USDZ.read(tmp_path / f"{name}.usda")
        assert caught.value.file == str(tmp_path / f"{name}.usda")


def test_the_memory_of_the_process_is_limited() -> None:
    module = "genre_tasks.exchange.usd.stage_dump"
    code = f"import numpy as np; from {module} import limit_memory; limit_memory({{}}); np.empty(2**28)"
    # Two gigabytes: more than a small file may take, and less than a large one.
    results = [
        subprocess.run([sys.executable, "-c", code.format(size)], capture_output=True, text=True, check=False)
        for size in (1000, 2**26)
    ]
    assert results[0].returncode == 1 and "MemoryError" in results[0].stderr
    assert results[1].returncode == 0


def test_without_openusd_the_error_says_what_to_install() -> None:
    code = """
import sys
from genre_tasks.errors import ConfigError
from genre_tasks.exchange.registry import load_format
sys.modules["pxr"] = None
try:
    load_format("usdz")
except ConfigError as error:
    print(error)
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert "needs the package pxr" in done.stdout and "pip install 'genre[usd]'" in done.stdout
