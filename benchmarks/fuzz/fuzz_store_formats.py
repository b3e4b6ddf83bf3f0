"""The readers of stores, weights and scenes: Parquet, EXR, safetensors, manifests, Gaussians."""

from __future__ import annotations

import io
import json
import shutil
from collections.abc import Iterator, Sequence
from functools import partial
from pathlib import Path
from random import Random
from typing import Any

import numpy as np

from benchmarks.fuzz import fuzz_attacks, fuzz_samples, fuzz_table_attacks
from benchmarks.fuzz.fuzz_mutations import BYTES, JSON, TEXT, change_json
from benchmarks.fuzz.fuzz_target import LARGE_TABLE_MEMORY_MIB, FuzzTarget, give_samples, require_sound


def _prepare_artifact(kind: str, file: str, folder: Path) -> list[bytes]:
    from storage.codecs import get_codec

    get_codec(kind).write(folder, fuzz_samples.make_values()[kind])
    return [(folder / file).read_bytes()]


def _read_artifact(kind: str, depth: int, path: Path) -> object:
    from storage.codecs import get_codec

    return get_codec(kind).read(path.parents[depth], {})


def table_targets() -> Iterator[FuzzTarget]:
    """Lists the readers of Parquet."""
    from flows.budget.cost_table import find_shipped_table, load_cost_table
    from flows.simulation.path_file import read_path_file, tabulate_path
    from genre_tasks.ego_paths.ego_path import EgoPath
    from storage.contents import read_columns

    changes = (fuzz_table_attacks.change_table,) * 8
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
    bombs = (fuzz_table_attacks.make_large_table,)
    read = partial(_read_artifact, "reconstruction", 0)
    bound = LARGE_TABLE_MEMORY_MIB
    yield FuzzTarget("Parquet", "codec, large tables", "gaussians.parquet", prepare, read, bombs, 1, bound)
    views = partial(_prepare_artifact, "chunk", "views.parquet")
    columns = ["camera", "role"]
    yield FuzzTarget(
        "Parquet", "read_columns", "views.parquet", views, lambda path: read_columns(path, columns), damages, 6
    )
    shipped = give_samples(find_shipped_table("small").read_bytes())
    yield FuzzTarget(
        "Parquet", "load_cost_table", "cost.parquet", shipped, lambda path: load_cost_table(path, "small"), damages, 8
    )

    recorded = EgoPath(np.arange(3.0), np.arange(3.0), np.broadcast_to(np.eye(4), (3, 4, 4)).copy())
    table = give_samples(_write_columns(tabulate_path(recorded)))
    path_damages = (*damages, fuzz_table_attacks.make_large_table)
    yield FuzzTarget(
        "Parquet",
        "read_path_file",
        "p.parquet",
        table,
        lambda path: read_path_file(path, recorded),
        path_damages,
        8,
        512,
    )


def _write_columns(columns: dict[str, Any]) -> bytes:
    import pyarrow as pa
    import pyarrow.parquet as pq

    sink = io.BytesIO()
    pq.write_table(pa.table(dict(columns)), sink)
    return sink.getvalue()


def exr_targets() -> Iterator[FuzzTarget]:
    """Lists the readers of EXR."""
    from storage.codecs.exr import read_channels, write_channels

    shape = (fuzz_samples.HEIGHT_PX, fuzz_samples.WIDTH_PX)
    dtypes = {"R": np.float16, "Z": np.float32}

    def prepare(folder: Path) -> list[bytes]:
        write_channels(folder / "valid.exr", {name: np.full(shape, 0.5, dtype) for name, dtype in dtypes.items()})
        return [(folder / "valid.exr").read_bytes()]

    damages = (*BYTES, *(fuzz_attacks.change_exr,) * 8)
    yield FuzzTarget(
        "EXR", "read_channels", "0.exr", prepare, lambda path: read_channels(path, dtypes, shape), damages, 90
    )


def splat_targets() -> Iterator[FuzzTarget]:
    """Lists the readers of files of Gaussians and of points."""
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
    yield FuzzTarget(
        "USD", "format usdz", "0.usdz", partial(prepare, "usdz"), _read_splats, BYTES, 8, starts_process=True
    )
    packed = give_samples(fuzz_samples.make_compressed_ply())
    yield FuzzTarget("PLY", "format compressed.ply", "0.compressed.ply", packed, _read_splats, TEXT, 20)
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

    yield FuzzTarget("PLY", "read_ply", "1.ply", give_samples(ascii_ply), read_points, TEXT, 30)


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


def weight_targets() -> Iterator[FuzzTarget]:
    """Lists the readers of safetensors and of what lies next to them."""
    from flows.training.checkpoint import describe
    from genre_tasks.fixer.weight_files import check_described_weights
    from genre_tasks.fixer.weights import load_fnet
    from genre_tasks.learned.weight_files import check_optimiser_files
    from genre_tasks.learned.weights import load_optimiser
    from genre_tasks.weight_files import read_tensor_shapes
    from genre_tasks.weights import resolve_weights

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

    def prepare_shipped(file: str, folder: Path) -> list[bytes]:
        for suffix in (".safetensors", ".json"):
            shutil.copyfile(resolve_weights("fnet", "builtin").with_suffix(suffix), folder / f"fnet{suffix}")
        return [(folder / file).read_bytes()]

    def prepare_checkpoint(folder: Path) -> list[bytes]:
        from safetensors.numpy import save

        network = json.loads(fuzz_samples.write_optimiser(folder).with_suffix(".json").read_bytes())
        description = {"done": 1, "config": {}, "network": network, "scenes": [], "origin": {}, "pool": []}
        return [save({"generator": np.zeros(4, np.uint8)}, {"training": json.dumps(description)})]

    damages = (*BYTES, *(fuzz_attacks.change_safetensors,) * 8)
    changes = (*JSON, *(change_json,) * 8)
    yield FuzzTarget(
        "safetensors",
        "load_fnet",
        "fnet.json",
        partial(prepare_shipped, "fnet.json"),
        lambda path: load_fnet(path.with_suffix(".safetensors")),
        changes,
        4,
    )
    yield FuzzTarget("safetensors", "checkpoint", "c.safetensors", prepare_checkpoint, describe, damages, 10)
    yield FuzzTarget(
        "safetensors", "load_optimiser", "gnet.safetensors", partial(prepare, ".safetensors"), read, damages, 40
    )
    yield FuzzTarget(
        "safetensors", "configuration", "gnet.json", partial(prepare, ".json"), read, (*JSON, *(change_json,) * 8), 25
    )
    yield FuzzTarget("safetensors", "fixer", "fnet.safetensors", prepare_fixer, read_fixer, damages, 25)


def manifest_targets() -> Iterator[FuzzTarget]:
    """Lists the readers of manifests."""
    from storage.manifest import MANIFEST, parse_manifest

    damages = (*JSON, *(change_sealed,) * 20)
    samples = give_samples(*fuzz_samples.make_manifests())

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
    except Exception:
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
