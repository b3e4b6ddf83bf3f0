"""What tools of others make of our files, and we of theirs: Niantic's SPZ library, PlayCanvas, three.js and Khronos.

The tools come from npm into a temporary folder; without node and npm nothing is measured.
"""

from __future__ import annotations

import json
import shutil
import subprocess
import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from plyfile import PlyData
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from benchmarks.common.bench import NotMeasuredError, Row
from benchmarks.common.claims import Claim, claim
from genre_tasks.exchange.activations import logits_to_opacities, sh_dc_to_colors
from genre_tasks.exchange.clouds import transform_cloud
from genre_tasks.exchange.conversion import pose_scene
from genre_tasks.exchange.gltf.format import GLB
from genre_tasks.exchange.gltf.placement import GLTF_R_SCENE
from genre_tasks.exchange.one_cloud import make_resting_scene
from genre_tasks.exchange.ply import PLY
from genre_tasks.exchange.spz.axes import SPZ_R_SCENE
from genre_tasks.exchange.spz.format import SPZ
from genre_tasks.exchange.types import ExchangeScene, SplatCloud
from genre_tasks.logs.types import Float64

PACKAGES = ("@playcanvas/splat-transform@2.7.1", "gltf-validator@2.0.0-dev.3.10", "three@0.187.0")
MOST_SPZ_METRES = 0.5 / 4096 + 1e-6
MOST_PLACE = 1e-5
_SECONDS = 300
_LARGEST_LOGIT = 14.0
# PLY files of other tools have x right, y down and z ahead: half a turn about x from the axes of SPZ.
_SCENE_R_PHOTO: Float64 = SPZ_R_SCENE.T @ np.diag([1.0, -1.0, -1.0])
# The validator is older than the extension, whose names have a colon.
_UNKNOWN_NAME = "MESH_PRIMITIVE_INVALID_ATTRIBUTE"
_VALIDATE = """
import fs from "fs";
import validator from "gltf-validator";
const options = {maxIssues: 0};
const report = await validator.validateBytes(new Uint8Array(fs.readFileSync(process.argv[2])), options);
console.log(JSON.stringify(report.issues.messages));
"""
_PLAY = """
import fs from "fs";
import * as THREE from "three";
import {GLTFLoader} from "three/examples/jsm/loaders/GLTFLoader.js";
globalThis.self = globalThis;
const data = fs.readFileSync(process.argv[2]);
const buffer = data.buffer.slice(data.byteOffset, data.byteOffset + data.byteLength);
new GLTFLoader().parse(buffer, "", gltf => {
  const mixer = new THREE.AnimationMixer(gltf.scene);
  gltf.animations.forEach(clip => {
    const action = mixer.clipAction(clip);
    action.setLoop(THREE.LoopOnce);
    action.clampWhenFinished = true;
    action.play();
  });
  const moments = process.argv.slice(3).map(time => {
    mixer.setTime(Number(time));
    gltf.scene.updateMatrixWorld(true);
    const places = {};
    gltf.scene.traverse(node => { if (node.name) places[node.name] = node.matrixWorld.toArray(); });
    return places;
  });
  console.log(JSON.stringify(moments));
}, error => { console.error(error); process.exit(1); });
"""


def measure_interop(scene: ExchangeScene) -> Row:
    """Takes a scene through tools of others and compares what comes back.

    Args:
        scene: with actors. Formats without nodes get it as it is posed at its middle moment.

    Returns:
        For each way the largest differences; errors of the validator; the largest difference of an actor's place in
        three.js at three moments.

    Raises:
        NotMeasuredError: node or npm is missing, or a tool cannot be installed.
    """
    if not shutil.which("node") or not shutil.which("npm"):
        raise NotMeasuredError("node and npm are not installed")
    cloud = pose_scene(scene, len(scene.times_s) // 2)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        _install(folder)
        PLY.write(folder / "ours.ply", make_resting_scene(cloud))
        SPZ.write(folder / "ours.spz", make_resting_scene(cloud))
        GLB.write(folder / "ours.glb", scene)
        return {
            "gaussians": len(cloud),
            "ways": _measure_ways(folder, cloud),
            "validator": _validate(folder),
            "three_place": _play(folder, scene),
        }


def _install(folder: Path) -> None:
    for name, source in (("validate.mjs", _VALIDATE), ("play.mjs", _PLAY)):
        (folder / name).write_text(source)
    (folder / "package.json").write_text('{"private": true}')
    try:
        _run(folder, "npm", "install", "--no-audit", "--no-fund", "--ignore-scripts", *PACKAGES)
    except (subprocess.SubprocessError, OSError) as error:
        raise NotMeasuredError("npm cannot install the tools") from error


def _run(folder: Path, *command: str) -> str:
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=True, timeout=_SECONDS)
    return done.stdout


def _convert(folder: Path, *names: str) -> Path:
    """Through the files of these names, one after the other."""
    tool = "node_modules/@playcanvas/splat-transform/bin/cli.mjs"
    for source, target in pairwise(names):
        _run(folder, "node", tool, "-q", "-w", "-g", "cpu", source, target)
    return folder / names[-1]


def _measure_ways(folder: Path, cloud: SplatCloud) -> Row:
    ways: dict[str, SplatCloud] = {}
    to_photo = _turn(cloud, _SCENE_R_PHOTO.T)
    from_photo = _turn(cloud, _SCENE_R_PHOTO)
    # Their PLY has the axes of photographs, and ours is taken as having them too.
    rows: Row = {}
    ways["spz, ply"] = _read_ply(_convert(folder, "ours.spz", "a.ply"))
    ways["spz, sog, ply"] = _read_ply(_convert(folder, "ours.spz", "b.sog", "b.ply"))
    for name, found in ways.items():
        rows[name] = _compare(to_photo, found)
    rows["ply, sog, ply"] = _compare(cloud, _read_ply(_convert(folder, "ours.ply", "c.sog", "c.ply")))
    rows["ply, spz"] = _compare(from_photo, SPZ.read(_convert(folder, "ours.ply", "d.spz")).nodes[0].cloud)
    # They turn their Gaussians by half a turn about z for GLB.
    half_turn = _turn(cloud, GLTF_R_SCENE.T @ np.diag([-1.0, -1.0, 1.0]))
    rows["ply, glb"] = _compare(half_turn, GLB.read(_convert(folder, "ours.ply", "e.glb")).nodes[0].cloud)
    return rows


def _read_ply(path: Path) -> SplatCloud:
    """A file of that tool, which makes infinite logits of opacities 0 and 1: PLY files with these are refused."""
    data = PlyData.read(str(path), mmap=False)
    column = data["vertex"].data["opacity"]
    np.clip(column, -_LARGEST_LOGIT, _LARGEST_LOGIT, out=column)
    data.write(str(path))
    return PLY.read(path).nodes[0].cloud


def _turn(cloud: SplatCloud, rotation: Float64) -> SplatCloud:
    pose = np.eye(4)
    pose[:3, :3] = rotation
    return transform_cloud(cloud, pose)


def _compare(expected: SplatCloud, found: SplatCloud) -> Row:
    """Differences of Gaussians that may be in another order, each with the nearest one that is most alike."""
    if len(expected) != len(found):
        return {"missing": len(expected) - len(found)}
    before = _describe(expected)
    after = _describe(found)
    _, rows = cKDTree(after).query(before)
    matched = replace(found.select(rows), antialiased=None)
    sizes = np.exp(expected.log_scales.max(1).astype(np.float64))
    differences = np.abs(_covariances(expected) - _covariances(matched)).max((1, 2)) / sizes**2
    colors = sh_dc_to_colors(expected.sh_dc) - sh_dc_to_colors(matched.sh_dc)
    opacities = logits_to_opacities(expected.logit_opacities) - logits_to_opacities(matched.logit_opacities)
    return {
        "missing": 0,
        "matched": len(np.unique(rows)) / max(1, len(rows)),
        "means_m": float(np.abs(expected.means.astype(np.float64) - matched.means).max()),
        "covariances_p99": float(np.quantile(differences, 0.99)),
        "colors_p99": float(np.quantile(np.abs(colors), 0.99)),
        "opacities_p99": float(np.quantile(np.abs(opacities), 0.99)),
    }


def _describe(cloud: SplatCloud) -> Float64:
    opacities = logits_to_opacities(cloud.logit_opacities)[:, None]
    return np.concatenate([cloud.means, 0.1 * sh_dc_to_colors(cloud.sh_dc), 0.1 * opacities], 1)


def _covariances(cloud: SplatCloud) -> Float64:
    turn = Rotation.from_quat(np.roll(cloud.quats.astype(np.float64), -1, axis=1)).as_matrix()
    variance = np.exp(2 * cloud.log_scales.astype(np.float64))
    return np.asarray(turn @ (variance[:, :, None] * turn.transpose(0, 2, 1)))


def _validate(folder: Path) -> Row:
    messages: list[dict[str, Any]] = json.loads(_run(folder, "node", "validate.mjs", "ours.glb"))
    errors = [message for message in messages if message["severity"] == 0]
    unknown = [m for m in errors if m["code"] == _UNKNOWN_NAME and "KHR_gaussian_splatting:" in m["pointer"]]
    return {"errors": len(errors) - len(unknown), "names_of_the_extension": len(unknown)}


def _play(folder: Path, scene: ExchangeScene) -> float:
    moments = sorted({0, len(scene.times_s) // 2, len(scene.times_s) - 1})
    times = [str(np.float32(scene.times_s[moment])) for moment in moments]
    places = json.loads(_run(folder, "node", "play.mjs", "ours.glb", *times))
    gltf_SE3_scene = np.eye(4)
    gltf_SE3_scene[:3, :3] = GLTF_R_SCENE
    largest = 0.0
    for moment, found in zip(moments, places, strict=True):
        for node in scene.nodes:
            if node.motion is not None and node.motion.present[moment]:
                # three.js states matrices column by column.
                place = np.array(found[node.name]).reshape(4, 4).T
                expected = gltf_SE3_scene @ node.motion.scene_SE3_node[moment]
                largest = max(largest, float(np.abs(place - expected).max()))
    return largest


def interop_claims(rows: Sequence[Row]) -> Iterator[Claim]:
    """Claims that tools of others read our files as they are meant.

    Args:
        rows: see :func:`measure_interop`.
    """
    note = "largest over the scenes; tools from npm"
    missing = [abs(way["missing"]) for row in rows for way in row["ways"].values()]
    yield claim("exchange.interop_missing", max(missing, default=None), "<=", 0, "Gaussians", f"{note}, any way")
    # A way that loses Gaussians has no differences: which of them belong together is not known.
    spz = [row["ways"]["spz, ply"].get("means_m") for row in rows]
    farthest_m = None if None in spz else max(spz, default=None)
    yield claim("exchange.interop_spz", farthest_m, "<=", MOST_SPZ_METRES, "m", note)
    errors = [row["validator"]["errors"] for row in rows]
    yield claim("exchange.interop_validator", max(errors, default=None), "<=", 0, "errors", note)
    places = [row["three_place"] for row in rows]
    yield claim("exchange.interop_animation", max(places, default=None), "<=", MOST_PLACE, "m", note)


def interop_table(rows: Sequence[Row]) -> Iterator[str]:
    """Gives a line for each way through other tools.

    Args:
        rows: see :func:`measure_interop`.
    """
    yield "| way | matched | means, m | covariances, 99 % | colours, 99 % | opacities, 99 % |"
    yield "|---|---|---|---|---|---|"
    for row in rows:
        for name, way in row["ways"].items():
            if way["missing"]:
                yield f"| {name} | {way['missing']} Gaussians are missing | | | | |"
                continue
            values = " | ".join(f"{way[key]:.2g}" for key in list(way)[2:])
            yield f"| {name} | {way['matched']:.3f} | {values} |"
