"""An exchange scene as an OpenUSD stage: an Xform for each node, with its Gaussians below it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pxr import Gf, Tf, Usd, UsdGeom, UsdVol, Vt
from scipy.spatial.transform import Rotation

from genre_tasks.exchange.activations import logits_to_opacities, logs_to_scales
from genre_tasks.exchange.types import ExchangeNode, ExchangeScene, NodeMotion, SplatCloud
from genre_tasks.exchange.usd import names
from genre_tasks.exchange.usd.color_spaces import SRGB
from genre_tasks.logs.types import Float32, Float64

LARGEST_OPACITY = 1.0 - 2.0**-24
"""The largest float32 below 1: the logit of 1 itself would be infinite."""

_EXTENT_SIGMAS = 3.0
"""A Gaussian's extent in standard deviations: programs cull by it, and less would cut visible edges."""

_DEFAULT_RATE = 24.0
"""Time codes a second where nothing moves: OpenUSD's own default."""

_RATE_DIGITS = 6


def write_stage(path: Path, scene: ExchangeScene, file: Path) -> None:
    """Writes a layer.

    Args:
        path: ending with ``.usdc`` or ``.usda``; it does not exist.
        scene: of which all values are finite.
        file: that the layer is for, for errors.

    Raises:
        InputError: a scale does not fit into float32.
        pxr.Tf.ErrorException: the layer cannot be written.
    """
    stage = Usd.Stage.CreateNew(str(path))
    UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.z)
    UsdGeom.SetStageMetersPerUnit(stage, 1.0)
    codes = _set_times(stage, scene.times_s)
    root = UsdGeom.Xform.Define(stage, f"/{names.ROOT_PRIM}").GetPrim()
    stage.SetDefaultPrim(root)
    root.SetCustomDataByKey(names.VERSION, names.CURRENT_VERSION)
    root.SetCustomDataByKey(names.TIMES_S, Vt.DoubleArray(scene.times_s.tolist()))
    root.SetCustomDataByKey(names.FRAMES, Vt.Int64Array(list(scene.frames)))
    # OpenUSD multiplies rows from the left, so that its matrices are transposed.
    root.SetCustomDataByKey(names.WORLD_SE3_SCENE, Gf.Matrix4d(scene.world_SE3_scene.T.tolist()))
    root.SetCustomDataByKey(names.LOSSES, Vt.StringArray(list(scene.losses)))
    used: set[str] = set()
    for node in scene.nodes:
        xform = UsdGeom.Xform.Define(stage, root.GetPath().AppendChild(_make_identifier(node.name, used)))
        _set_node_data(xform.GetPrim(), node)
        if node.motion is not None:
            _set_motion(xform, node.motion, codes)
        child = xform.GetPath().AppendChild(names.GAUSSIANS_PRIM)
        _set_cloud(UsdVol.ParticleField3DGaussianSplat.Define(stage, child), node.cloud, file)
    stage.GetRootLayer().Save()


def _set_times(stage: Any, times_s: Float64) -> list[float]:
    """Sets the stage's clock; the time code of each moment."""
    rate = _DEFAULT_RATE
    if len(times_s) > 1:
        rate = round(float(1.0 / np.median(np.diff(times_s))), _RATE_DIGITS)
    codes = [names.to_time_code(float(time), rate) for time in times_s]
    stage.SetTimeCodesPerSecond(rate)
    stage.SetFramesPerSecond(rate)
    if codes:
        stage.SetStartTimeCode(codes[0])
        stage.SetEndTimeCode(codes[-1])
    return codes


def _make_identifier(name: str, used: set[str]) -> str:
    identifier = Tf.MakeValidIdentifier(name)
    # Two names may differ only in what an identifier cannot hold.
    while identifier in used:
        identifier += "_"
    used.add(identifier)
    return str(identifier)


def _set_node_data(prim: Any, node: ExchangeNode) -> None:
    prim.SetDisplayName(node.name)
    prim.SetCustomDataByKey(names.NAME, node.name)
    prim.SetCustomDataByKey(names.LABEL, node.label)
    prim.SetCustomDataByKey(names.TRACK_ID, node.track_id)
    prim.SetCustomDataByKey(names.SIZE_M, Gf.Vec3d(*node.size_m))
    prim.SetCustomDataByKey(names.MOVES, node.motion is not None)
    if node.cloud.antialiased is not None:
        prim.SetCustomDataByKey(names.ANTIALIASED, node.cloud.antialiased)


def _set_motion(xform: Any, motion: NodeMotion, codes: list[float]) -> None:
    # Apart, because OpenUSD blends a matrix entry by entry between two samples, which shears what turns.
    translate = xform.AddTranslateOp(UsdGeom.XformOp.PrecisionDouble)
    orient = xform.AddOrientOp(UsdGeom.XformOp.PrecisionDouble)
    rows = np.flatnonzero(motion.present)
    quats = _continue_signs(Rotation.from_matrix(motion.scene_SE3_node[rows, :3, :3]).as_quat())
    for row, (x, y, z, w) in zip(rows, quats.tolist(), strict=True):
        translate.Set(Gf.Vec3d(*motion.scene_SE3_node[row, :3, 3].tolist()), codes[row])
        orient.Set(Gf.Quatd(w, x, y, z), codes[row])
    if motion.present.all():
        return
    visibility = UsdGeom.Imageable(xform).CreateVisibilityAttr()
    for code, present in zip(codes, motion.present, strict=True):
        visibility.Set(UsdGeom.Tokens.inherited if present else UsdGeom.Tokens.invisible, code)


def _continue_signs(quats: NDArray[np.float64]) -> NDArray[np.float64]:
    """Chooses the sign of each quaternion [F, 4] so that a blend with the one before takes the short way."""
    if not len(quats):
        return quats
    steps = np.where((quats[1:] * quats[:-1]).sum(1) < 0, -1.0, 1.0)
    return quats * np.cumprod(np.concatenate([[1.0], steps]))[:, None]


def _set_cloud(field: Any, cloud: SplatCloud, file: Path) -> None:
    scales = logs_to_scales(file, cloud.log_scales)
    quats = _normalize(cloud.quats)
    # In memory OpenUSD's quaternions have the real part last.
    imaginary_first = np.ascontiguousarray(np.roll(quats, -1, axis=1))
    coefficients = np.concatenate([cloud.sh_dc[:, None], cloud.sh_rest], 1).reshape(-1, 3)
    field.CreatePositionsAttr(Vt.Vec3fArray.FromNumpy(np.ascontiguousarray(cloud.means)))
    field.CreateScalesAttr(Vt.Vec3fArray.FromNumpy(np.ascontiguousarray(scales)))
    field.CreateOrientationsAttr(Vt.QuatfArray.FromNumpy(imaginary_first))
    opacities = np.minimum(logits_to_opacities(cloud.logit_opacities), LARGEST_OPACITY).astype(np.float32)
    field.CreateOpacitiesAttr(Vt.FloatArray.FromNumpy(opacities))
    # Written always: a file that leaves it out has degree 3.
    field.CreateRadianceSphericalHarmonicsDegreeAttr(cloud.sh_degree)
    field.CreateRadianceSphericalHarmonicsCoefficientsAttr(Vt.Vec3fArray.FromNumpy(coefficients))
    # OpenUSD takes colours for linear light where none is stated, and a stage around this one may state another.
    Usd.ColorSpaceAPI.Apply(field.GetPrim()).CreateColorSpaceNameAttr(SRGB)
    UsdGeom.Boundable(field).CreateExtentAttr(_find_extent(cloud.means, scales, quats))


def _normalize(quats: Float32) -> Float32:
    norms = np.linalg.norm(quats.astype(np.float64), axis=1, keepdims=True)
    identity = np.array([1.0, 0.0, 0.0, 0.0])
    return np.where(norms > 0, quats / np.where(norms > 0, norms, 1.0), identity).astype(np.float32)


def _find_extent(means: Float32, scales: Float32, quats: Float32) -> Any:
    if not len(means):
        return Vt.Vec3fArray([Gf.Vec3f(0.0), Gf.Vec3f(0.0)])
    w, x, y, z = quats.T.astype(np.float64)
    rows = np.stack(
        [
            np.stack([1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)], 1),
            np.stack([2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)], 1),
            np.stack([2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)], 1),
        ],
        1,
    )
    # The standard deviation along each axis of the scene: the root of the covariance's diagonal.
    reach = _EXTENT_SIGMAS * np.sqrt(np.square(rows * scales[:, None, :]).sum(2))
    low = (means - reach).min(0).tolist()
    high = (means + reach).max(0).tolist()
    return Vt.Vec3fArray([Gf.Vec3f(*low), Gf.Vec3f(*high)])
