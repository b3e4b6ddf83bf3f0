"""OpenUSD layers of other programs, and hostile ones."""

from __future__ import annotations

import struct
import zipfile
from pathlib import Path

import numpy as np
import pytest
from pxr import Gf, Usd, UsdGeom, UsdVol, Vt
from scipy.spatial.transform import Rotation

from genre_tasks.errors import InputError
from genre_tasks.exchange.activations import logits_to_opacities
from genre_tasks.exchange.usd.format import USDZ
from tests.exchange.splat_clouds import make_driving_scene
from tests.exchange.usd_layers import make_layer, write_zip
from tests.exchange.usd_layers import read_in_this_process as read_in_this_process
from tests.exchange.usd_layers import real_process as real_process

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


def test_invisible_fields_are_a_loss(tmp_path: Path) -> None:
    path = tmp_path / "foreign.usda"
    make_layer(path)
    stage = Usd.Stage.Open(str(path))
    UsdGeom.Imageable(stage.GetPrimAtPath("/World/splat")).MakeInvisible()
    stage.Save()
    scene = USDZ.read(path)
    assert scene.nodes == () and "Invisible are 1 fields of Gaussians, which are not read." in scene.losses


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
    for before, after, words in (
        ("double[] timesS = [0,", "double[] timesS = [9,", "do not rise"),
        ("int64[] frames = [20, ", "int64[] frames = [", "do not rise"),
        ("int64[] frames = [20, ", "double[] frames = [inf, ", "no numbers of log frames"),
        ("int64[] frames = [20, ", "int64[] frames = [1000000000000, ", "no numbers of log frames"),
        ("int64[] frames = [20, ", 'string[] frames = ["x"] # ', "no numbers of log frames"),
        ("double3 sizeM = (4.5, 1.8, 1.5)", 'string[] sizeM = ["a", "b", "c"]', "no array of numbers"),
        ("matrix4d worldSE3Scene = ", 'string[] worldSE3Scene = ["x"] # ', "no array of numbers"),
    ):
        assert before in text, before
        path.write_text(text.replace(before, after))
        with pytest.raises(InputError, match=words):
            USDZ.read(path)
