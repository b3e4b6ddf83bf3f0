"""GLB files built, changed and played by the specification alone, without the code that is tested."""

from __future__ import annotations

import json
import struct
from typing import Any

import numpy as np
from numpy.typing import NDArray

PREFIX = "KHR_gaussian_splatting:"
COMPONENTS = {5120: "i1", 5121: "u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
WIDTHS = {"SCALAR": 1, "VEC3": 3, "VEC4": 4}


def split_glb(data: bytes) -> tuple[dict[str, Any], bytes]:
    """JSON and binary part."""
    magic, version, length = struct.unpack_from("<4sII", data)
    assert (magic, version, length) == (b"glTF", 2, len(data))
    size, kind = struct.unpack_from("<I4s", data, 12)
    assert kind == b"JSON" and size % 4 == 0
    document = json.loads(data[20 : 20 + size])
    if len(data) == 20 + size:
        return document, b""
    binary_size, kind = struct.unpack_from("<I4s", data, 20 + size)
    assert kind == b"BIN\0" and binary_size % 4 == 0 and 28 + size + binary_size == len(data)
    return document, data[28 + size :]


def join_glb(document: dict[str, Any] | bytes, binary: bytes = b"") -> bytes:
    text = document if isinstance(document, bytes) else json.dumps(document).encode()
    text = text.ljust(-(-len(text) // 4) * 4)
    binary = binary.ljust(-(-len(binary) // 4) * 4, b"\0")
    chunks = struct.pack("<I4s", len(text), b"JSON") + text
    if binary:
        chunks += struct.pack("<I4s", len(binary), b"BIN\0") + binary
    return struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks


def read_accessor(document: dict[str, Any], binary: bytes, index: int) -> NDArray[np.float64]:
    accessor = document["accessors"][index]
    view = document["bufferViews"][accessor["bufferView"]]
    width = WIDTHS[accessor["type"]]
    dtype = np.dtype(COMPONENTS[accessor["componentType"]])
    start = view["byteOffset"] + accessor.get("byteOffset", 0)
    assert start % dtype.itemsize == 0
    size = accessor["count"] * width * dtype.itemsize
    assert size <= view["byteLength"] and start + size <= document["buffers"][0]["byteLength"] <= len(binary)
    return np.frombuffer(binary[start : start + size], dtype).reshape(-1, width).astype(np.float64)


def make_matrix(translation: Any, rotation: Any, scale: Any) -> NDArray[np.float64]:
    x, y, z, w = np.asarray(rotation, np.float64) / np.linalg.norm(rotation)
    # The columns are where the axes go, by p + 2 w (v × p) + 2 v × (v × p).
    vector = np.array([x, y, z])
    columns = [p + 2 * w * np.cross(vector, p) + 2 * np.cross(vector, np.cross(vector, p)) for p in np.eye(3)]
    out = np.eye(4)
    out[:3, :3] = np.stack(columns, 1) * np.asarray(scale)
    out[:3, 3] = translation
    return out


def play(data: bytes, time_s: float) -> dict[str, NDArray[np.float64]]:
    """Where nodes are in glTF's coordinates at a moment, by their names: a small player of LINEAR and STEP."""
    document, binary = split_glb(data)
    parts = [
        {
            "translation": np.array(node.get("translation", [0, 0, 0]), np.float64),
            "rotation": np.array(node.get("rotation", [0, 0, 0, 1]), np.float64),
            "scale": np.array(node.get("scale", [1, 1, 1]), np.float64),
        }
        for node in document["nodes"]
    ]
    for animation in document.get("animations", []):
        for channel in animation["channels"]:
            sampler = animation["samplers"][channel["sampler"]]
            times = read_accessor(document, binary, sampler["input"])[:, 0]
            values = read_accessor(document, binary, sampler["output"])
            target = channel["target"]
            parts[target["node"]][target["path"]] = _sample(times, values, time_s, sampler["interpolation"])
    found: dict[str, NDArray[np.float64]] = {}

    def place(index: int, above: NDArray[np.float64]) -> None:
        node = document["nodes"][index]
        found[node["name"]] = above @ make_matrix(**parts[index])
        for child in node.get("children", []):
            place(child, found[node["name"]])

    for root in document["scenes"][document["scene"]]["nodes"]:
        place(root, np.eye(4))
    return found


def _sample(
    times: NDArray[np.float64], values: NDArray[np.float64], time_s: float, interpolation: str
) -> NDArray[np.float64]:
    last = int(np.flatnonzero(times <= max(time_s, times[0]))[-1])
    if interpolation == "STEP" or last == len(times) - 1:
        return values[last]
    fraction = (max(time_s, times[0]) - times[last]) / (times[last + 1] - times[last])
    before = values[last]
    after = values[last + 1]
    if values.shape[1] == 3:
        return before + fraction * (after - before)
    cosine = float(before @ after)
    angle = np.arccos(min(abs(cosine), 1.0))
    if angle < 1e-4:
        return before + fraction * (np.copysign(1.0, cosine) * after - before)
    return (np.sin((1 - fraction) * angle) * before + np.copysign(np.sin(fraction * angle), cosine) * after) / np.sin(
        angle
    )


def foreign_file(
    attributes: dict[str, tuple[NDArray[Any], bool]], *, stride: int = 0, **changes: Any
) -> tuple[dict[str, Any], bytes]:
    """A file of one node of Gaussians as another tool might write it.

    Args:
        attributes: values by name, and whether they are normalized.
        stride: bytes from one element to the next, where elements are padded.
        changes: of the primitive's extension object.
    """
    accessors = []
    views = []
    binary = b""
    for values, normalized in attributes.values():
        rows = values.reshape(len(values), -1)
        element = rows.dtype.itemsize * rows.shape[1]
        step = stride or element
        padded = b"".join(row.tobytes().ljust(step, b"\xaa") for row in rows)
        views.append({"buffer": 0, "byteOffset": len(binary), "byteLength": len(padded)})
        if stride:
            views[-1]["byteStride"] = stride
        kind = next(code for code, name in COMPONENTS.items() if np.dtype(name) == rows.dtype)
        accessors.append(
            {
                "bufferView": len(views) - 1,
                "componentType": kind,
                "count": len(rows),
                "type": next(name for name, width in WIDTHS.items() if width == rows.shape[1]),
                "normalized": normalized,
            }
        )
        binary += padded.ljust(-(-len(padded) // 4) * 4, b"\0")
    extension = {"kernel": "ellipse", "colorSpace": "srgb_rec709_display"} | changes
    primitive = {
        "mode": 0,
        "attributes": {name: k for k, name in enumerate(attributes)},
        "extensions": {"KHR_gaussian_splatting": extension},
    }
    document = {
        "asset": {"version": "2.0"},
        "extensionsUsed": ["KHR_gaussian_splatting"],
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": [primitive]}],
        "accessors": accessors,
        "bufferViews": views,
        "buffers": [{"byteLength": len(binary)}],
    }
    return document, binary


def float_attributes(count: int = 6, seed: int = 0, sh_degree: int = 0) -> dict[str, tuple[NDArray[Any], bool]]:
    """Gaussians as floats, in glTF's axes."""
    random = np.random.default_rng(seed)
    quats = random.normal(size=(count, 4))
    values = {
        "POSITION": random.uniform(-9, 9, (count, 3)),
        f"{PREFIX}ROTATION": quats / np.linalg.norm(quats, axis=1, keepdims=True),
        f"{PREFIX}SCALE": random.uniform(0.05, 0.5, (count, 3)),
        f"{PREFIX}OPACITY": random.uniform(0.1, 0.9, count),
        f"{PREFIX}SH_DEGREE_0_COEF_0": random.uniform(-1, 1, (count, 3)),
    }
    for degree in range(1, sh_degree + 1):
        for n in range(2 * degree + 1):
            values[f"{PREFIX}SH_DEGREE_{degree}_COEF_{n}"] = random.uniform(-0.5, 0.5, (count, 3))
    return {name: (value.astype("<f4"), False) for name, value in values.items()}
