"""Every reader of files that others may have written, with valid files of its format and the damages that suit it."""

from __future__ import annotations

import io
import json
import shutil
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from random import Random
from typing import Any

import numpy as np

from benchmarks.scale import fuzz_attacks, fuzz_samples
from benchmarks.scale.fuzz_mutations import BYTES, JSON, TEXT, Mutation, change_json

MEMORY_MIB = 256
"""Reading a small file may add so much to the process's memory at most."""

IMAGE_MEMORY_MIB = 1024
"""Images of up to 100 million pixels are read."""


@dataclass(frozen=True)
class FuzzTarget:
    """A reader and what is fed to it.

    Attributes:
        format: the format that findings are counted under.
        reader: name of the reader.
        file: name of the file that is damaged, in the target's folder.
        prepare: writes the other files that the reader needs, and gives valid contents of ``file``.
        read: reads the folder's file by the product's reader; raises ``WrongReadError`` for an impossible value.
        damages: drawn with equal chances.
        share: how many of all inputs it gets, in proportion to those of other targets.
        memory_mib: bound of what one input may add to the process's memory.
        starts_process: whether the reader works in a process of its own.
    """

    format: str
    reader: str
    file: str
    prepare: Callable[[Path], list[bytes]]
    read: Callable[[Path], object]
    damages: Sequence[Mutation]
    share: int = 10
    memory_mib: int = MEMORY_MIB
    starts_process: bool = False


class WrongReadError(Exception):
    """A reader returned what no valid file can hold."""


def require_sound(condition: object, expected: str) -> None:
    """Raises ``WrongReadError`` unless a condition holds."""
    if not condition:
        raise WrongReadError(expected)


def list_targets() -> tuple[FuzzTarget, ...]:
    """Lists all targets in a fixed order."""
    return tuple(
        target
        for group in (_json, _pickle, _images, _tables, _exr, _splats, _yaml, _weights, _manifests)
        for target in group()
    )


def _json() -> Iterator[FuzzTarget]:
    from flows.reconstruction.record_files import read_record
    from flows.simulation.path_file import read_path_file
    from genre_tasks.ego_paths.ego_path import EgoPath
    from genre_tasks.json_files import read_json_object
    from genre_tasks.logs.pandaset.file_reading import read_entries, read_times
    from genre_tasks.logs.pandaset.layout import parse_pose
    from genre_tasks.logs.posed_images.transforms_json import read_transforms

    def read_poses(path: Path) -> object:
        entries = read_entries(path, "log")
        return [parse_pose(entry, file=path, log="log", frame=frame) for frame, entry in enumerate(entries)]

    poses = np.broadcast_to(np.eye(4), (3, 4, 4)).copy()
    recorded = EgoPath(np.arange(3.0), np.arange(3.0), poses)
    rows = [{"time_s": 0.5 * k, "lateral_m": 0.5, "ahead_m": 0.0} for k in range(4)]
    readers: tuple[tuple[str, str, Any, Callable[[Path], object]], ...] = (
        ("read_json_object", "x.json", fuzz_samples.make_run_record(), partial(_read_object, read_json_object)),
        ("read_record", "run.json", fuzz_samples.make_run_record(), read_record),
        ("read_transforms", "transforms.json", fuzz_samples.make_transforms(), read_transforms),
        ("read_path_file", "path.json", rows, lambda path: read_path_file(path, recorded)),
        ("parse_pose", "poses.json", fuzz_samples.make_sequence_poses(), read_poses),
        ("read_times", "timestamps.json", [1.5e9, 1.5e9 + 0.1], lambda path: read_times(path, "log")),
        ("list_pins", "pin.json", {"name": "n", "keys": ["a"], "note": "", "pinned_at": "t"}, _read_pins),
    )
    for name, file, value, read in readers:
        yield FuzzTarget("JSON", name, file, _sample(fuzz_samples.dump(value)), read, JSON)


def _read_object(read: Callable[..., dict[str, Any]], path: Path) -> object:
    return read(path, "file", "Write it again.")


def _read_pins(path: Path) -> object:
    from flows.upkeep.pins import PINS, list_pins
    from storage.local import LocalStore

    folder = path.parent / "store" / PINS / "n"
    folder.mkdir(parents=True, exist_ok=True)
    shutil.copyfile(path, folder / "pin.json")
    return list_pins(LocalStore(path.parent / "store"))


def _sample(*contents: bytes) -> Callable[[Path], list[bytes]]:
    return lambda folder: list(contents)


def _pickle() -> Iterator[FuzzTarget]:
    from genre_tasks.logs.pandaset.cuboids import build_tracks, read_boxes
    from genre_tasks.logs.pandaset.pickle_reader import read_table
    from genre_tasks.logs.pandaset.sweeps import build_sweep

    def read(path: Path) -> object:
        table = read_table(path, log="log", frame=0)
        require_sound(all(len(c) == table.row_count for c in table.columns.values()), "columns of one length")
        if "x" in table.columns:
            return build_sweep(table, 0, file=path, log="log")
        return build_tracks([read_boxes(table, 0, file=path, log="log")])

    damages = (*BYTES, *(fuzz_attacks.make_running_pickle,) * 3, *(fuzz_attacks.change_pickle,) * 8)
    damages += (fuzz_attacks.compress_pickle,)
    yield FuzzTarget("pickle", "read_table", "00.pkl", _sample(*fuzz_samples.pickle_tables()), read, damages, 90, 640)


def _images() -> Iterator[FuzzTarget]:
    from genre_tasks.logs.pandaset.image_sizes import measure_images
    from genre_tasks.scene.image_decoding import decode_with_facts, inspect_image, read_image_size
    from storage.codecs.png import read_png

    def read(path: Path) -> object:
        data = path.read_bytes()
        measure_images({0: path})
        width, height = read_image_size(data)
        inspect_image(data)
        image = decode_with_facts(data, 16, 9)
        require_sound(image.pixels.shape == (9, 16, 3) and width > 0 and height > 0, "pixels of the asked size")
        return image

    for kind, change, name in (
        ("JPEG", fuzz_attacks.change_jpeg, "0.jpg"),
        ("PNG", fuzz_attacks.change_png, "0.png"),
    ):
        samples = _sample(*fuzz_samples.encode_pictures(kind))
        damages = (*BYTES, *(change,) * 5)
        yield FuzzTarget(kind, "decode_with_facts", name, samples, read, damages, 70, IMAGE_MEMORY_MIB)
    picture = _sample(fuzz_samples.encode_pictures("PNG")[0])
    damages = (*BYTES, *(fuzz_attacks.change_png,) * 5)
    yield FuzzTarget("PNG", "read_png", "0.png", picture, read_png, damages, 20, IMAGE_MEMORY_MIB)


def _prepare_artifact(kind: str, file: str, folder: Path) -> list[bytes]:
    from storage.codecs import get_codec

    get_codec(kind).write(folder, fuzz_samples.make_values()[kind])
    return [(folder / file).read_bytes()]


def _read_artifact(kind: str, depth: int, path: Path) -> object:
    from storage.codecs import get_codec

    return get_codec(kind).read(path.parents[depth], {})


def _tables() -> Iterator[FuzzTarget]:
    from flows.budget.cost_table import find_shipped_table, load_cost_table
    from flows.simulation.path_file import read_path_file, tabulate_path
    from genre_tasks.ego_paths.ego_path import EgoPath
    from storage.contents import read_columns

    changes = (fuzz_attacks.change_table,) * 8
    damages = (*BYTES, *changes)
    artifacts = {
        "chunk": ("chunk.parquet", "views.parquet", "points.parquet", "actors.parquet", "marks.parquet"),
        "reconstruction": ("gaussians.parquet", "losses.parquet"),
        "evaluation": ("metrics.parquet", "views.parquet"),
        "novel_views": ("views.parquet",),
    }
    for kind, files in artifacts.items():
        for file in files:
            prepare = partial(_prepare_artifact, kind, file)
            yield FuzzTarget("Parquet", f"codec of {kind}", file, prepare, partial(_read_artifact, kind, 0), damages, 8)
    prepare = partial(_prepare_artifact, "reconstruction", "gaussians.parquet")
    bombs = (*changes, fuzz_attacks.make_large_table)
    read = partial(_read_artifact, "reconstruction", 0)
    yield FuzzTarget("Parquet", "codec, large tables", "gaussians.parquet", prepare, read, bombs, 1, 512)
    views = partial(_prepare_artifact, "chunk", "views.parquet")
    columns = ["camera", "role"]
    yield FuzzTarget("Parquet", "read_columns", "views.parquet", views, lambda path: read_columns(path, columns), damages, 6)
    shipped = _sample(find_shipped_table("small").read_bytes())
    yield FuzzTarget("Parquet", "load_cost_table", "cost.parquet", shipped, lambda path: load_cost_table(path, "small"), damages, 8)

    recorded = EgoPath(np.arange(3.0), np.arange(3.0), np.broadcast_to(np.eye(4), (3, 4, 4)).copy())
    table = _sample(_write_columns(tabulate_path(recorded)))
    bombs = (*damages, fuzz_attacks.make_large_table)
    yield FuzzTarget("Parquet", "read_path_file", "p.parquet", table, lambda path: read_path_file(path, recorded), bombs, 8, 512)


def _write_columns(columns: dict[str, Any]) -> bytes:
    import pyarrow as pa
    import pyarrow.parquet as pq

    sink = io.BytesIO()
    pq.write_table(pa.table(dict(columns)), sink)
    return sink.getvalue()


def _exr() -> Iterator[FuzzTarget]:
    from storage.codecs.exr import read_channels, write_channels

    shape = (fuzz_samples.HEIGHT_PX, fuzz_samples.WIDTH_PX)
    dtypes = {"R": np.float16, "Z": np.float32}

    def prepare(folder: Path) -> list[bytes]:
        write_channels(folder / "valid.exr", {name: np.full(shape, 0.5, dtype) for name, dtype in dtypes.items()})
        return [(folder / "valid.exr").read_bytes()]

    damages = (*BYTES, *(fuzz_attacks.change_exr,) * 8)
    yield FuzzTarget("EXR", "read_channels", "0.exr", prepare, lambda path: read_channels(path, dtypes, shape), damages, 90)


def _splats() -> Iterator[FuzzTarget]:
    from genre_tasks.scene.ply_reader import check_ply_header, read_ply

    def prepare(name: str, folder: Path) -> list[bytes]:
        from genre_tasks.exchange.registry import load_format

        file = folder / f"valid{load_format(name).suffixes[0]}"
        load_format(name).write(file, fuzz_samples.make_cloud())
        return [file.read_bytes()]

    for name, title, file, damages, share in (
        ("ply", "PLY", "0.ply", TEXT, 50),
        ("spz", "SPZ", "0.spz", BYTES, 20),
        ("glb", "GLB", "0.glb", (*BYTES, *(fuzz_attacks.change_glb,) * 10), 30),
        ("splat", "splat", "0.splat", BYTES, 5),
    ):
        yield FuzzTarget(title, f"format {name}", file, partial(prepare, name), _read_splats, damages, share)
    yield FuzzTarget("USD", "format usdz", "0.usdz", partial(prepare, "usdz"), _read_splats, BYTES, 8, starts_process=True)
    ascii_ply = b"ply\nformat ascii 1.0\nelement vertex 2\n"
    ascii_ply += b"".join(b"property float %c\n" % c for c in b"xyz")
    ascii_ply += b"".join(b"property uchar %s\n" % c for c in (b"red", b"green", b"blue"))
    ascii_ply += b"end_header\n1 2 3 4 5 6\n1.5 2.5 3.5 0 255 7\n"

    def read_points(path: Path) -> object:
        check_ply_header(path)
        positions, colors = read_ply(path)
        require_sound(colors is None or len(colors) == len(positions), "a colour for each point")
        require_sound(np.isfinite(positions).all(), "finite points")
        return positions

    yield FuzzTarget("PLY", "read_ply", "1.ply", _sample(ascii_ply), read_points, TEXT, 30)


def _read_splats(path: Path) -> object:
    from genre_tasks.exchange.checks import CLOUD_ATTRIBUTES
    from genre_tasks.exchange.registry import find_format

    scene = find_format(path).read(path)
    for node in scene.nodes:
        arrays = [getattr(node.cloud, name) for name in CLOUD_ATTRIBUTES]
        require_sound(len({len(array) for array in arrays}) == 1, "arrays of one length")
        require_sound(all(np.isfinite(array).all() for array in arrays), "finite Gaussians")
    require_sound(np.isfinite(scene.world_SE3_scene).all(), "a finite pose")
    return scene


def _yaml() -> Iterator[FuzzTarget]:
    from flows.configuration.loading import load_configuration
    from flows.simulation.edit_file import read_edit_file
    from flows.yaml_values import read_yaml_mapping

    edits = b"edits:\n  - remove: car-3\n  - move: car-4\n    forward_m: 2.5\n    left_m: -1\n  - retime: car-5\n    delay_s: 0.5\n"
    settings = b"gnet:\n  iterations: 24\n  snapshots: 0\ningest:\n  width_px: 320\n  height_px: 180 # half\n"
    settings += b"novel_views:\n  shifts_m: [1.0, -3]\neffects: auto\n"
    damages = (*TEXT, *(fuzz_attacks.attack_yaml,) * 6)

    def read(path: Path) -> object:
        return read_yaml_mapping(path, "file", "keys", "Write keys.")

    yield FuzzTarget("YAML", "read_yaml_mapping", "x.yaml", _sample(settings, edits), read, damages, 40)
    yield FuzzTarget("YAML", "read_edit_file", "edits.yaml", _sample(edits), read_edit_file, damages, 25)
    yield FuzzTarget(
        "YAML", "load_configuration", "c.yaml", _sample(settings), lambda path: load_configuration("small", path), damages, 25
    )


def _weights() -> Iterator[FuzzTarget]:
    from genre_tasks.fixer.weight_files import check_described_weights
    from genre_tasks.learned.weight_files import check_optimiser_files
    from genre_tasks.learned.weights import load_optimiser
    from genre_tasks.weight_files import read_tensor_shapes

    def prepare(suffix: str, folder: Path) -> list[bytes]:
        return [fuzz_samples.write_optimiser(folder).with_suffix(suffix).read_bytes()]

    def prepare_fixer(folder: Path) -> list[bytes]:
        fuzz_samples.write_optimiser(folder).rename(folder / "fnet.safetensors")
        document = {"model": "small", "architecture": {"vae": {}, "unet": {}, "residual": True}}
        (folder / "fnet.json").write_bytes(fuzz_samples.dump(document))
        return [(folder / "fnet.safetensors").read_bytes()]

    def read(path: Path) -> object:
        check_optimiser_files(path.with_suffix(".safetensors"))
        return load_optimiser(path.with_suffix(".safetensors"))

    def read_fixer(path: Path) -> object:
        read_tensor_shapes(path, "Train it again.")
        return check_described_weights(path, "small")

    damages = (*BYTES, *(fuzz_attacks.change_safetensors,) * 8)
    yield FuzzTarget("safetensors", "load_optimiser", "gnet.safetensors", partial(prepare, ".safetensors"), read, damages, 40)
    yield FuzzTarget("safetensors", "configuration", "gnet.json", partial(prepare, ".json"), read, (*JSON, *(change_json,) * 8), 25)
    yield FuzzTarget("safetensors", "fixer", "fnet.safetensors", prepare_fixer, read_fixer, damages, 25)


def _manifests() -> Iterator[FuzzTarget]:
    from storage.manifest import MANIFEST, parse_manifest

    damages = (*JSON, *(change_sealed,) * 20)
    samples = _sample(*fuzz_samples.make_manifests())

    def parse(path: Path) -> object:
        manifest = parse_manifest(path.read_bytes(), path)
        folder = Path("/store") / manifest.address.relative_path
        for file in manifest.files:
            inside = Path.resolve(folder / file.path).is_relative_to(folder)
            require_sound(inside, "files inside of the artifact")
        return manifest

    yield FuzzTarget("manifest", "parse_manifest", MANIFEST, samples, parse, damages, 50)
    yield FuzzTarget("manifest", "LocalStore", MANIFEST, samples, _read_from_store, damages, 30)


def change_sealed(rng: Random, data: bytes, others: Sequence[bytes]) -> bytes:
    """Changes a manifest and computes its digests again, as somebody would who means harm."""
    from storage.keys import digest_value
    from storage.manifest import FileEntry, payload_digest

    body = json.loads(change_json(rng, data, others))
    if not isinstance(body, dict):
        return change_json(rng, data, others)
    body.pop("manifest_sha256", None)
    try:
        body["payload_digest"] = payload_digest([FileEntry.model_validate(entry) for entry in body["files"]])
        body["manifest_sha256"] = digest_value(body)
    except Exception:  # noqa: BLE001
        # What cannot be digested stays as it is.
        body["manifest_sha256"] = ""
    return json.dumps(body).encode("utf-8", "surrogatepass")


def _read_from_store(path: Path) -> object:
    from storage.address import Address
    from storage.local import LocalStore

    address = Address("d", "l", 0, "evaluate/gnet", fuzz_samples.KEY)
    store = LocalStore(path.parent / "store")
    folder = store.root / address.relative_path
    folder.mkdir(parents=True, exist_ok=True)
    shutil.copyfile(path, folder / path.name)
    list(store.artifacts())
    problems = list(store.verify_all())
    artifact = store.find(address)
    require_sound(artifact is not None and len(problems) == 1, "one artifact")
    return artifact
