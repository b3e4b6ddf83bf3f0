"""GLB files that are damaged, or made to do harm."""

from __future__ import annotations

import tracemalloc
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from genre_tasks.errors import InputError
from genre_tasks.exchange.gltf.format import GLB
from tests.exchange.foreign_glb import check_refused, read_foreign
from tests.exchange.gltf_files import PREFIX, float_attributes, foreign_file, join_glb

Change = Callable[[dict[str, Any]], None]


def set_at(*keys: Any) -> Change:
    """Sets what the keys but the last lead to."""

    def change(document: dict[str, Any]) -> None:
        target: Any = document
        for key in keys[:-2]:
            target = target[key]
        target[keys[-2]] = keys[-1]

    return change


def loop(document: dict[str, Any]) -> None:
    document["nodes"] = [{"mesh": 0, "children": [1]}, {"children": [0]}]


def two_parents(document: dict[str, Any]) -> None:
    document["nodes"] = [{"children": [2]}, {"children": [2]}, {"mesh": 0}]
    document["scenes"] = [{"nodes": [0, 1]}]


EXTENSION = ("meshes", 0, "primitives", 0, "extensions", "KHR_gaussian_splatting")
ATTRIBUTES = ("meshes", 0, "primitives", 0, "attributes")


@pytest.mark.parametrize(
    ("change", "problem"),
    [
        (loop, "several parents, or is below itself"),
        (two_parents, "several parents, or is below itself"),
        (set_at("scenes", [{"nodes": [7]}]), "node 7 of 1"),
        (set_at("scene", 3), "scene 3 of 1"),
        (set_at("nodes", 0, "mesh", 5), "mesh 5 of 1"),
        (set_at("nodes", 0, "mesh", -1), "nodes.0.mesh"),
        (set_at("nodes", 0, "scale", [1, 1, -1]), "mirrored or flat"),
        (set_at("nodes", 0, "scale", [1, 1, 0]), "mirrored or flat"),
        (set_at("nodes", 0, "translation", [1e300, 0, 0]), "finite place"),
        (set_at("nodes", 0, "translation", [0, 0]), "nodes.0.translation"),
        (set_at("nodes", 0, "rotation", [0, 0, 0, 0]), "rotation without direction"),
        (set_at("nodes", 0, "matrix", [1.0] * 16), "no affine map"),
        (set_at(*ATTRIBUTES, "POSITION", 99), "accessor 99 of 5"),
        (set_at(*ATTRIBUTES, "POSITION", 3), "unexpected type, SCALAR"),
        (set_at(*ATTRIBUTES, {"POSITION": 0}), "no KHR_gaussian_splatting:ROTATION"),
        (set_at(*ATTRIBUTES, f"{PREFIX}SH_DEGREE_2_COEF_0", 4), "no KHR_gaussian_splatting:SH_DEGREE_1_COEF_0"),
        (set_at("meshes", 0, "primitives", 0, "mode", 4), "no points"),
        (set_at(*EXTENSION, []), "no points"),
        (set_at(*EXTENSION, "kernel", "cube"), "kernel cube"),
        (set_at(*EXTENSION, "colorSpace", "other"), "colour space other"),
        (set_at(*EXTENSION, "extensions", {"KHR_gaussian_splatting_compression_spz": {}}), "compression_spz"),
        (set_at("extensionsRequired", ["KHR_draco_mesh_compression"]), "KHR_draco_mesh_compression"),
        (set_at("asset", "version", "1.0"), "not glTF 2"),
        (set_at("asset", 3), "asset"),
        (set_at("accessors", 0, "count", 7), "reaches beyond its buffer"),
        (set_at("accessors", 1, "count", 5), "has 5 values for 6 Gaussians"),
        (set_at("accessors", 0, "count", 0), "accessors.0.count"),
        (set_at("accessors", 0, "byteOffset", 2**62), "reaches beyond its buffer"),
        (set_at("accessors", 0, "componentType", 1), "unexpected type"),
        (set_at("accessors", 0, "bufferView", 50), "buffer view 50 of 5"),
        (set_at("accessors", 1, "componentType", 5123), "unexpected type"),
        (set_at("bufferViews", 0, "byteLength", 2**40), "reaches beyond its buffer"),
        (set_at("bufferViews", 0, "byteOffset", 2**40), "reaches beyond its buffer"),
        (set_at("bufferViews", 0, "byteStride", 4), "reaches beyond its buffer"),
        (set_at("bufferViews", 0, "buffer", 1), "buffer 1 of 1"),
        (set_at("buffers", 0, "byteLength", 10**9), "claims 1000000000 bytes"),
        (set_at("buffers", 0, "uri", "/etc/passwd"), "outside of its binary part"),
        (set_at("buffers", [{"byteLength": 4, "uri": "https://example.org/x.bin"}]), "outside of its binary part"),
        (set_at("nodes", 0, "extras", {"genre": {"label": 5}}), "genre do not fit: label"),
        (set_at("asset", "extras", {"genre": {"frames": [1, 2]}}), "2 log frames for 0 moments"),
        (set_at("asset", "extras", {"genre": {"world_SE3_scene": [1.0]}}), "world_SE3_scene"),
        (set_at("asset", "extras", {"genre": {"frames": [10**30], "times_s": [0.0]}}), "genre do not fit: frames.0"),
        (set_at("asset", "extras", {"genre": {"frames": [1, 2], "times_s": [0, 0]}}), "moments of the file do not"),
        (set_at("asset", "extras", {"genre": {"losses": ["x" * 1001]}}), "genre do not fit: losses.0"),
    ],
)
def test_unsound_documents(tmp_path: Path, change: Change, problem: str) -> None:
    document, binary = foreign_file(float_attributes())
    change(document)
    check_refused(tmp_path, document, binary, problem)


@pytest.mark.parametrize(
    ("name", "value", "problem"),
    [
        ("POSITION", np.nan, "not finite"),
        (f"{PREFIX}SCALE", -0.1, "scales below 0"),
        (f"{PREFIX}OPACITY", 1.1, "opacities outside"),
        (f"{PREFIX}ROTATION", 0.0, "without a direction"),
        (f"{PREFIX}SH_DEGREE_0_COEF_0", np.inf, "not finite"),
    ],
)
def test_unsound_values(tmp_path: Path, name: str, value: float, problem: str) -> None:
    attributes = float_attributes()
    attributes[name][0][2] = value
    check_refused(tmp_path, *foreign_file(attributes), problem)


def animated(times: list[float], values: list[list[float]], **changes: Any) -> tuple[dict[str, Any], bytes]:
    document, binary = foreign_file(float_attributes())
    for array, kind in ((np.array(times, "<f4"), "SCALAR"), (np.array(values, "<f4"), "VEC3")):
        document["bufferViews"].append({"buffer": 0, "byteOffset": len(binary), "byteLength": array.nbytes})
        document["accessors"].append(
            {"bufferView": len(document["accessors"]), "componentType": 5126, "count": len(array), "type": kind}
        )
        binary += array.tobytes()
    document["buffers"][0]["byteLength"] = len(binary)
    channel = {"sampler": 0, "target": {"node": 0, "path": "translation"} | changes}
    document["animations"] = [{"channels": [channel], "samplers": [{"input": 5, "output": 6}]}]
    return document, binary


def test_unsound_animations(tmp_path: Path) -> None:
    way = [[0.0, 0, 0], [1, 0, 0]]
    assert read_foreign(tmp_path, *animated([0, 1], way)).nodes[0].motion is not None
    check_refused(tmp_path, *animated([1, 0], way), "times do not rise")
    check_refused(tmp_path, *animated([-1, 0], way), "times do not rise")
    check_refused(tmp_path, *animated([0, 1, 2], way), "2 values at 3 times")
    check_refused(tmp_path, *animated([0, 1], way, node=9), "node 9 of 1")
    check_refused(tmp_path, *animated([0, 1], way, path="rotation"), "unexpected type")
    check_refused(tmp_path, *animated([0, 1], [[1, 1, 1], [1, 2, 1]], path="scale"), "scaled unevenly")
    check_refused(tmp_path, *animated([0, 1], [[1, 1, 1], [1, 1, -1]], path="scale"), "mirrored")
    document, binary = animated([0, 1], way)
    document["animations"][0]["channels"] *= 2
    check_refused(tmp_path, document, binary, "moved twice")
    losses = read_foreign(tmp_path, *animated([0, 1], [[1, 1, 1], [2, 2, 2]], path="scale")).losses
    assert losses == ("Moving nodes change their size, and have that of their first moment.",)
    assert "animates" in read_foreign(tmp_path, *animated([0, 1], way, path="weights")).losses[0]


@pytest.mark.parametrize(
    ("text", "problem"),
    [
        (b"[" * 200_000, "nested too deeply|cannot be parsed"),
        (b'{"asset":' * 50_000, "nested too deeply|cannot be parsed"),
        (b'{"asset":{"version":"2.0"},"scene":' + b"9" * 100_000 + b"}", "cannot be parsed"),
        (b'{"asset":{"version":"2.0"},"nodes":[{"translation":[NaN,0,0]}]}', "cannot be parsed"),
        (b'{"asset":{"version":"2.0"},"nodes":[{"translation":[1e999,0,0]}]}', "nodes.0.translation"),
        (b"\xff\xfe{}", "cannot be parsed"),
        (b"null", "no glTF"),
        (b"{}", "asset"),
    ],
)
def test_unsound_json(tmp_path: Path, text: bytes, problem: str) -> None:
    check_refused(tmp_path, text, b"", problem)


def test_long_json_is_not_parsed(tmp_path: Path) -> None:
    check_refused(tmp_path, b"[" + b"0," * (9 << 20) + b"0]", b"", "at most 16777216 are read")


def assert_refused_within(folder: Path, document: dict[str, Any], binary: bytes, most_bytes: int) -> None:
    (folder / "bomb.glb").write_bytes(join_glb(document, binary))
    tracemalloc.start()
    try:
        with pytest.raises(InputError, match="far more memory than its size"):
            GLB.read(folder / "bomb.glb")
        assert tracemalloc.get_traced_memory()[1] < most_bytes
    finally:
        tracemalloc.stop()


def test_memory_is_bounded(tmp_path: Path) -> None:
    # Arrays without a view are zero, however long.
    document, binary = foreign_file(float_attributes())
    for accessor in document["accessors"]:
        del accessor["bufferView"]
        accessor["count"] = 2**31
    assert_refused_within(tmp_path, document, binary, 1 << 20)
    # One mesh, shown by many nodes.
    document, binary = foreign_file(float_attributes(count=100_000))
    document["nodes"] = [{"mesh": 0} for _ in range(60)]
    document["scenes"] = [{"nodes": list(range(60))}]
    assert_refused_within(tmp_path, document, binary, 600 << 20)
    # Many nodes below one that moves at many moments.
    times = np.arange(3000.0)
    document, binary = animated(times.tolist(), np.zeros((3000, 3)).tolist())
    document["nodes"] = [{"children": list(range(1, 2000))}, *({} for _ in range(1999))]
    assert_refused_within(tmp_path, document, binary, 300 << 20)
