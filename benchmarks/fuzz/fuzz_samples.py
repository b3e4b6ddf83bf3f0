"""Small valid files of every format, made by the writers of this project: what damages begin with."""

from __future__ import annotations

import io
import json
import struct
from pathlib import Path
from typing import Any

import numpy as np

HEIGHT_PX = 5
WIDTH_PX = 7
KEY = "5f41c0de"


def make_picture(width: int = 48, height: int = 32) -> np.ndarray[Any, np.dtype[np.uint8]]:
    """Makes an image [H, W, 3] with edges and slopes."""
    # No plain colour: decoders have short cuts for it, and damage would hit nothing.
    rows, columns = np.mgrid[0:height, 0:width]
    image = np.stack([rows * 5 % 256, columns * 3 % 256, (rows * columns) % 256], axis=2)
    return image.astype(np.uint8)


def encode_pictures(format: str) -> list[bytes]:
    """Encodes the picture as JPEG (also progressive and grey) or PNG (also of 16 bits, a palette and with alpha)."""
    from PIL import Image

    image = Image.fromarray(make_picture())
    grey = Image.fromarray(make_picture()[:, :, 0].astype(np.uint16) << 7)
    variants: list[tuple[Any, dict[str, Any]]]
    if format == "JPEG":
        variants = [(image, {}), (image, {"progressive": True}), (image.convert("L"), {}), (image.convert("CMYK"), {})]
    else:
        variants = [
            (image, {}),
            (image.convert("P"), {}),
            (image.convert("RGBA"), {}),
            (grey, {}),
            (image.convert("1"), {}),
        ]
    files = []
    for picture, options in variants:
        sink = io.BytesIO()
        picture.save(sink, format, **options)
        files.append(sink.getvalue())
    return files


def encode_other_pictures() -> list[bytes]:
    """Encodes the picture in the other formats that logs may have."""
    from PIL import Image

    image = Image.fromarray(make_picture())
    files = []
    for name in ("WEBP", "TIFF", "BMP", "GIF", "JPEG2000", "PPM"):
        for options in ({}, {"compression": "tiff_lzw"}, {"compression": "jpeg"}) if name == "TIFF" else ({},):
            sink = io.BytesIO()
            image.save(sink, name, **options)
            files.append(sink.getvalue())
    return files


def pickle_tables() -> list[bytes]:
    """Pickles a sweep and a table of cuboids."""
    from genre_tasks.logs.pandaset.pickle_writer import pickle_table

    count = 6
    numbers = np.linspace(-3.0, 3.0, count)
    sweep = {name: numbers + k for k, name in enumerate(("x", "y", "z", "i", "t"))} | {"d": np.arange(count) % 2}
    words = np.array([f"box-{k}" for k in range(count)], dtype=object)
    names = ("yaw", "position.x", "position.y", "position.z", "dimensions.x", "dimensions.y", "dimensions.z")
    boxes: dict[str, Any] = {"uuid": words, "label": np.array(["Car", None] * 3, dtype=object)}
    boxes |= {"stationary": np.arange(count) % 2 == 0} | dict.fromkeys(names, numbers + 5)
    return [pickle_table(sweep), pickle_table(boxes)]


def make_values() -> dict[str, Any]:
    """Makes a small value of the kinds of artifacts that hold tables, EXR images and PNG pictures."""
    import torch

    from genre_tasks.logs.types import Lens
    from genre_tasks.metrics.results import Evaluation, Metric, ViewScore
    from genre_tasks.scene.actor_node import ActorNode
    from genre_tasks.scene.chunk import Actor, Chunk, LogIssue, Points, View
    from genre_tasks.scene.gaussians import Gaussians
    from genre_tasks.scene.graph import SceneGraph
    from genre_tasks.scene.novel_views import NovelView, NovelViews
    from genre_tasks.scene.reconstruction import Reconstruction

    rng = np.random.default_rng(0)
    pose = np.eye(4)
    lens = Lens(10.0, 10.0, 3.5, 2.5, WIDTH_PX, HEIGHT_PX, (0.1, 0.0, 0.0, 0.0, 0.0))
    points = Points(
        rng.normal(size=(6, 3)).astype(np.float32),
        rng.integers(0, 256, (6, 3), dtype=np.uint8),
        np.ones(6, bool),
        np.zeros(6, np.int16),
    )
    image = encode_pictures("PNG")[0]
    views = tuple(View("front", k, "source", float(k), pose, lens, image) for k in range(2))
    poses = np.broadcast_to(pose, (2, 4, 4)).copy()
    actor = Actor("t0", "Car", (4.0, 2.0, 1.5), np.arange(2), poses, points)
    node = ActorNode("t0", "Car", (4.0, 2.0, 1.5), np.arange(2), poses)
    packed = torch.from_numpy(rng.normal(size=(9, 14)).astype(np.float32))
    scene = SceneGraph(Gaussians.unpack(packed), torch.from_numpy(np.arange(9) % 3), (node,))
    novel = tuple(NovelView("front", k, 3.0, pose, lens, ("front", k)) for k in range(2))
    color = torch.full((2, HEIGHT_PX, WIDTH_PX, 3), 0.25)
    alpha = torch.full((2, HEIGHT_PX, WIDTH_PX), 0.5)
    return {
        "chunk": Chunk(
            dataset="d",
            log="l",
            index=0,
            frames=(0, 1),
            camera_names=("front",),
            width_px=WIDTH_PX,
            height_px=HEIGHT_PX,
            world_SE3_chunk=pose,
            chunk_SE3_ego=poses,
            views=views,
            static=points,
            actors=(actor,),
            log_issues=(LogIssue("missing_sweep", "none", frame=1),),
        ),
        "reconstruction": Reconstruction(scene, (0.5, 0.25), {8: scene}, (1.0, 2.0), {"behind": 3}),
        "novel_views": NovelViews(novel, color, alpha, alpha, color, alpha, alpha),
        "evaluation": Evaluation(
            "gnet",
            (Metric("interpolation/psnr", 30.0, 2), Metric("shift_3m/kernel", 0.5, 2, 0.1, 0.9)),
            (ViewScore("front", 1, 0.0, 30.0, 0.9, 0.1),),
            ((0, 20.0), (8, 30.0)),
            {"front_1": make_picture(6, 4)},
        ),
    }


def make_cloud() -> Any:
    """Makes a scene of eight Gaussians with harmonics of degree one."""
    from genre_tasks.exchange.one_cloud import make_resting_scene
    from genre_tasks.exchange.types import SplatCloud

    rng = np.random.default_rng(1)

    def numbers(*shape: int) -> Any:
        return rng.uniform(-1.0, 1.0, shape).astype(np.float32)

    cloud = SplatCloud(numbers(8, 3), numbers(8, 3), numbers(8, 4), numbers(8), numbers(8, 3), numbers(8, 3, 3))
    return make_resting_scene(cloud, ())


def make_compressed_ply() -> bytes:
    """Writes eight Gaussians as SuperSplat compresses them: one chunk of bounds, and four numbers for each."""
    bounds = [f"{end}_{axis}" for end in ("min", "max") for axis in "xyz"]
    bounds += [f"{end}_scale_{axis}" for end in ("min", "max") for axis in "xyz"]
    header = ["ply", "format binary_little_endian 1.0", "element chunk 1", *(f"property float {b}" for b in bounds)]
    header += ["element vertex 8"]
    header += [f"property uint packed_{name}" for name in ("position", "rotation", "scale", "color")]
    values = [-1.0, -1.0, -1.0, 1.0, 1.0, 1.0, -3.0, -3.0, -3.0, 0.0, 0.0, 0.0]
    # Any bits are a packed Gaussian.
    packed = np.arange(32, dtype="<u4") * np.uint32(99_999_989)
    return "\n".join([*header, "end_header", ""]).encode() + struct.pack("<12f", *values) + packed.tobytes()


def make_manifests() -> list[bytes]:
    """Writes manifests with and without measurements."""
    from storage.manifest import FileEntry, Manifest, payload_digest

    files = (FileEntry(path="b/x.exr", sha256="1" * 64, size=3), FileEntry(path="a.parquet", sha256="2" * 64, size=4))
    plain = {"kind": "chunk", "dataset": "d", "log": "l", "chunk": 0, "stage": "evaluate/gnet", "key": KEY}
    plain |= {"files": files, "payload_digest": payload_digest(files)}
    full = plain | {"inputs": {"chunk": "k"}, "configuration": {"a": [1, 2.5]}, "measurements": {"n": [1, None]}}
    return [Manifest.model_validate(values).to_json() for values in (plain, full | {"warnings": ("w",)})]


def make_run_record() -> dict[str, Any]:
    """Makes what readers of ``run.json`` rely on."""
    stage = {"stage": "gnet", "key": KEY, "cached": False, "seconds": 1.5, "metrics": {"psnr": 30.0}}
    chunk = {"chunk": 0, "stages": [stage]}
    record = {"run": "5f41c0de9a1b", "log": "l", "preset": "small", "report": "report.html", "config": {"a": {"b": 1}}}
    return record | {"differs": {}, "chunks": [chunk], "left_out": [{"chunk": 1}]}


def make_transforms() -> dict[str, Any]:
    """Makes a ``transforms.json`` of two frames."""
    matrix = np.eye(4).tolist()
    frames = [{"file_path": f"images/{k}.png", "transform_matrix": matrix, "time": 0.1 * k} for k in range(2)]
    lens = {"w": 48, "h": 32, "fl_x": 40.0, "fl_y": 40.0, "cx": 24.0, "cy": 16.0, "k1": 0.01}
    return lens | {"camera_model": "OPENCV", "frames": frames}


def make_sequence_poses() -> list[dict[str, Any]]:
    """Makes a ``poses.json`` of a PandaSet camera."""
    pose = {"position": {"x": 1.0, "y": 2.0, "z": 0.5}, "heading": {"w": 1.0, "x": 0.0, "y": 0.0, "z": 0.0}}
    return [pose, pose]


def write_colmap_model(file: str, folder: Path) -> list[bytes]:
    """Writes a sparse model of one camera and two images, in bytes or text.

    Returns:
        The bytes of ``file``.
    """
    cameras = struct.pack("<QiiQQ4d", 1, 1, 1, 48, 32, 40.0, 40.0, 24.0, 16.0)
    images = struct.pack("<Q", 2)
    for number in (1, 2):
        images += struct.pack("<i7di", number, 1.0, 0.0, 0.0, 0.0, 0.0, 0.0, float(number), 1) + b"%d.png\0" % number
        images += struct.pack("<Q2dq", 1, 3.0, 4.0, -1)
    if file.endswith(".bin"):
        (folder / "cameras.bin").write_bytes(cameras)
        (folder / "images.bin").write_bytes(images)
    else:
        (folder / "cameras.txt").write_text("# cameras\n1 PINHOLE 48 32 40 40 24 16\n")
        (folder / "images.txt").write_text("1 1 0 0 0 0 0 1 1 1.png\n3 4 -1\n2 1 0 0 0 0 0 2 1 2.png\n\n")
    return [(folder / file).read_bytes()]


def write_optimiser(folder: Path) -> Path:
    """Writes the weights of a small learned optimiser with their configuration.

    Returns:
        The file of the tensors.
    """
    import torch

    from genre_tasks.learned.learned_optimiser import LearnedOptimiser
    from genre_tasks.learned.network import NetworkConfig
    from genre_tasks.learned.weights import save_optimiser

    path = folder / "gnet.safetensors"
    # The same weights in every process: an input follows from its index.
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        save_optimiser(LearnedOptimiser(NetworkConfig(hidden=4, channels=(4, 4))), path)
    return path


def dump(value: Any) -> bytes:
    """Writes JSON as people do, with line ends."""
    return json.dumps(value, indent=1).encode()
