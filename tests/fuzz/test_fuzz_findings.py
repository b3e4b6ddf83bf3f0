"""What the fuzzers have found stays mended: docs/results/fuzz.md lists it."""

from __future__ import annotations

import gzip
import io
import json
import resource
import struct
import subprocess
import sys
import zipfile
import zlib
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from PIL import Image

from benchmarks.fuzz import fuzz_samples
from benchmarks.fuzz.fuzz_samples import make_picture
from flows.budget.cost_table import find_shipped_table, load_cost_table
from flows.simulation.path_file import read_path_file
from flows.training.checkpoint import describe
from flows.upkeep.pins import PINS, list_pins
from genre_tasks.bounded_parquet import FOR_COLUMNS, FOR_ROWS, MemoryBound, TableTooLargeError, read_bounded_table
from genre_tasks.ego_paths.ego_path import EgoPath
from genre_tasks.errors import ArtifactCorruptError, ConfigError, InputError
from genre_tasks.exchange.usd.package import extract_layers
from genre_tasks.learned.weights import load_optimiser
from genre_tasks.logs.pandaset.pickle_reader import read_table as read_pickle
from genre_tasks.logs.posed_images.transforms_json import read_transforms
from genre_tasks.pickles.pickle_machine import MAX_OPCODES
from genre_tasks.scene.image_decoding import decode_pixels, read_image_size
from genre_tasks.scene.ply_reader import read_ply
from genre_tasks.weights import list_weights_files
from storage.codecs import get_codec
from storage.codecs.exr import read_channels, write_channels
from storage.codecs.png import encode_png, read_png
from storage.codecs.tables import column, read_table, schema, write_table
from storage.local import LocalStore
from storage.manifest import parse_manifest
from storage.objects.payloads import Payloads

TABLE = schema("fuzz/1", [column("x", pa.int64(), "number"), column("text", pa.string(), "words")])


@pytest.mark.parametrize("key", ["fl_x", "w", "k1"])
def test_integers_of_hundreds_of_digits_are_no_intrinsics(tmp_path: Path, key: str) -> None:
    path = tmp_path / "transforms.json"
    path.write_text(json.dumps(fuzz_samples.make_transforms() | {key: 10**400}))
    with pytest.raises(InputError, match=f"number for {key}"):
        read_transforms(path)


def test_times_of_hundreds_of_digits_are_no_times(tmp_path: Path) -> None:
    values = fuzz_samples.make_transforms()
    values["frames"][1]["time"] = 10**400
    (tmp_path / "transforms.json").write_text(json.dumps(values))
    with pytest.raises(InputError, match=r"time of images/1\.png is no number"):
        read_transforms(tmp_path / "transforms.json")


def test_matrices_of_hundreds_of_digits_are_no_poses(tmp_path: Path) -> None:
    values = fuzz_samples.make_transforms()
    values["frames"][1]["transform_matrix"][0][0] = 10**400
    (tmp_path / "transforms.json").write_text(json.dumps(values))
    with pytest.raises(InputError, match="transform_matrix of 4 × 4 numbers"):
        read_transforms(tmp_path / "transforms.json")


def test_infinite_schema_versions_are_no_manifest() -> None:
    data = fuzz_samples.make_manifests()[0].replace(b'"schema_version": 1', b'"schema_version": 1e999')
    with pytest.raises(ArtifactCorruptError, match="not readable"):
        parse_manifest(data, Path("manifest.json"))


def test_nested_pins_are_damaged(tmp_path: Path) -> None:
    (tmp_path / PINS / "n").mkdir(parents=True)
    (tmp_path / PINS / "n" / "pin.json").write_text('{"a":' * 100_000)
    with pytest.raises(InputError, match="pin is damaged"):
        list_pins(LocalStore(tmp_path))


def test_nested_descriptions_of_weights_have_no_base(tmp_path: Path) -> None:
    (tmp_path / "fnet.json").write_text("[" * 100_000)
    assert list_weights_files(tmp_path / "fnet.safetensors") == {"configuration": tmp_path / "fnet.json"}


def _pack_chunk(name: bytes, data: bytes) -> bytes:
    return struct.pack(">I", len(data)) + name + data + struct.pack(">I", zlib.crc32(name + data))


def _pack_png(width: int, height: int, content: bytes) -> bytes:
    header = struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)
    body = _pack_chunk(b"IHDR", header) + _pack_chunk(b"IDAT", zlib.compress(content)) + _pack_chunk(b"IEND", b"")
    return b"\x89PNG\r\n\x1a\n" + body


@pytest.mark.parametrize("side", [10_001, 60_000, 2**31 - 1])
def test_pictures_of_too_many_pixels_are_refused(tmp_path: Path, side: int) -> None:
    (tmp_path / "p.png").write_bytes(_pack_png(side, side, b""))
    with pytest.raises(ArtifactCorruptError, match=r"p\.png"):
        read_png(tmp_path / "p.png")


def test_palettes_with_opacities_of_more_colours_are_refused() -> None:
    sink = io.BytesIO()
    Image.fromarray(make_picture()).convert("P").save(sink, "PNG")
    data = sink.getvalue()
    start = data.find(b"IDAT") - 4
    with pytest.raises(InputError, match="cannot decode the image: palette index out of range"):
        decode_pixels(data[:start] + _pack_chunk(b"tRNS", bytes(range(150)) * 2) + data[start:], 4, 4)


def test_jpegs_of_many_scans_are_refused() -> None:
    sink = io.BytesIO()
    Image.fromarray(make_picture()).save(sink, "JPEG", progressive=True)
    data = sink.getvalue()
    assert read_image_size(data) == (48, 32)
    scan = data[data.rfind(b"\xff\xda") : -2]
    with pytest.raises(InputError, match="too many scans"):
        read_image_size(data[:-2] + scan * 200 + data[-2:])


def test_large_exr_images_are_refused_before_they_are_decoded(tmp_path: Path) -> None:
    write_channels(tmp_path / "a.exr", {"R": np.zeros((7000, 7000), np.float16)})
    assert (tmp_path / "a.exr").stat().st_size < 1 << 20
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    with pytest.raises(ArtifactCorruptError, match=r"\(7000, 7000\), expected \(5, 7\)"):
        read_channels(tmp_path / "a.exr", {"R": np.float16}, (5, 7))
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 20 << 10


def test_pickles_of_millions_of_opcodes_are_refused(tmp_path: Path) -> None:
    (tmp_path / "00.pkl").write_bytes(gzip.compress(b"\x80\x02](" + b"N" * (MAX_OPCODES + 10) + b"e."))
    with pytest.raises(InputError, match=f"more than {MAX_OPCODES} opcodes"):
        read_pickle(tmp_path / "00.pkl")


def test_ply_counts_of_thousands_of_digits_are_refused(tmp_path: Path) -> None:
    (tmp_path / "a.ply").write_text(f"ply\nformat ascii 1.0\nelement vertex {'9' * 5000}\nend_header\n")
    with pytest.raises(InputError, match="line 3: '999999999999999999' is no vertex count"):
        read_ply(tmp_path / "a.ply")


def test_usdz_members_before_the_file_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "a.usdz"
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("scene.usda", "#usda 1.0\n")
    data = path.read_bytes()
    # The directory claims to lie far behind its place, so that members lie before the file's first byte.
    end = data.rfind(b"PK\x05\x06")
    (start,) = struct.unpack_from("<I", data, end + 16)
    path.write_bytes(data[: end + 16] + struct.pack("<I", start + 1000) + data[end + 20 :])
    with pytest.raises(InputError, match="package cannot be read"):
        extract_layers(path, tmp_path)


@pytest.mark.parametrize("channels", [[-1, 4], [0, 4], [10**6, 4], [10**18], [4] * 2000])
def test_networks_larger_than_any_are_refused(tmp_path: Path, channels: list[int]) -> None:
    weights = fuzz_samples.write_optimiser(tmp_path)
    config = weights.with_suffix(".json")
    config.write_text(json.dumps(json.loads(config.read_text()) | {"channels": channels}))
    with pytest.raises(ConfigError, match="channels"):
        load_optimiser(weights)


_READ_WITHIN_A_GIGABYTE = """
import resource, sys
from pathlib import Path
from storage.codecs.png import encode_png, read_png
used = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
resource.setrlimit(resource.RLIMIT_AS, (used + (1 << 30), resource.RLIM_INFINITY))
print(read_png(Path(sys.argv[1])).shape)
"""


def test_a_chunk_that_claims_gigabytes_takes_none(tmp_path: Path) -> None:
    path = tmp_path / "p.png"
    data = bytearray(encode_png(make_picture()))
    length = data.index(b"IDAT") - 4
    data[length] = 0xE8
    path.write_bytes(data)
    command = [sys.executable, "-c", _READ_WITHIN_A_GIGABYTE, str(path)]
    done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=120)
    assert done.stdout.strip() == str(make_picture().shape), done.stderr


def test_networks_larger_than_their_file_take_no_memory(tmp_path: Path) -> None:
    weights = fuzz_samples.write_optimiser(tmp_path)
    config = weights.with_suffix(".json")
    config.write_text(json.dumps(json.loads(config.read_text()) | {"channels": [512] * 8}))
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    with pytest.raises(InputError, match="do not fit"):
        load_optimiser(weights)
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 200 << 10


@pytest.mark.parametrize("text", ["[]", "3", "[" * 100_000])
def test_checkpoints_describe_themselves_by_an_object(tmp_path: Path, text: str) -> None:
    from safetensors.numpy import save

    (tmp_path / "c.safetensors").write_bytes(save({"generator": np.zeros(4, np.uint8)}, {"training": text}))
    with pytest.raises(InputError, match="checkpoint cannot be read"):
        describe(tmp_path / "c.safetensors")


def _change_shipped_table(folder: Path, change: Callable[[pa.Table], pa.Table]) -> Path:
    pq.write_table(change(pq.read_table(find_shipped_table("small"))), folder / "cost.parquet")
    return folder / "cost.parquet"


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda table: table.slice(0, 0), "no setting"),
        (lambda table: table.replace_schema_metadata(dict(table.schema.metadata) | {b"cold_seconds": b"["}), "damaged"),
        (
            lambda table: table.replace_schema_metadata(dict(table.schema.metadata) | {b"calibration_s": b"x"}),
            "damaged",
        ),
        (lambda table: _without(table, b"judged"), "judged"),
    ],
)
def test_cost_tables_without_settings_or_facts_are_refused(
    tmp_path: Path, change: Callable[[pa.Table], pa.Table], message: str
) -> None:
    with pytest.raises(ConfigError, match=message):
        load_cost_table(_change_shipped_table(tmp_path, change), "small")


def _without(table: pa.Table, key: bytes) -> pa.Table:
    return table.replace_schema_metadata({k: v for k, v in table.schema.metadata.items() if k != key})


def test_cost_tables_with_text_for_seconds_are_damaged(tmp_path: Path) -> None:
    def change(table: pa.Table) -> pa.Table:
        index = table.column_names.index("stage_seconds")
        return table.set_column(index, table.schema.field(index), pa.array(["{"] * len(table)))

    with pytest.raises(ArtifactCorruptError, match="setting does not decode"):
        load_cost_table(_change_shipped_table(tmp_path, change), "small")


def _write_repeated(path: Path, rows: int) -> None:
    """A table of equal rows: a few bytes for each of the groups of rows."""
    block = pa.table({"x": np.zeros(100_000, np.int64), "text": pa.array(["x"] * 100_000)}, schema=TABLE)
    with pq.ParquetWriter(path, TABLE, compression="ZSTD") as writer:
        for _ in range(rows // 100_000):
            writer.write_table(block)


def test_tables_that_repeat_rows_are_refused_before_they_are_read(tmp_path: Path) -> None:
    path = tmp_path / "t.parquet"
    _write_repeated(path, 20_000_000)
    assert path.stat().st_size < 1 << 20
    with pytest.raises(ArtifactCorruptError, match="MiB of memory"):
        read_table(path, TABLE)


def test_tables_that_repeat_a_long_text_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "t.parquet"
    texts = pa.DictionaryArray.from_arrays(np.zeros(100_000, np.int32), ["x" * 10_000])
    # Without Arrow's schema the column is one of texts, stored once and referred to.
    pq.write_table(pa.table({"x": np.zeros(100_000, np.int64), "text": texts}), path, store_schema=False)
    assert pq.read_schema(path).field("text").type == pa.string()
    with pytest.raises(TableTooLargeError):
        read_bounded_table(path, FOR_COLUMNS)
    # The numbers of the same file are few.
    assert read_bounded_table(path, FOR_COLUMNS, ["x"]).num_rows == 100_000


def test_rows_of_python_count_for_more(tmp_path: Path) -> None:
    path = tmp_path / "t.parquet"
    _write_repeated(path, 400_000)
    assert read_bounded_table(path, FOR_COLUMNS).num_rows == 400_000
    with pytest.raises(TableTooLargeError):
        read_bounded_table(path, FOR_ROWS)
    poses = np.broadcast_to(np.eye(4), (3, 4, 4)).copy()
    with pytest.raises(InputError, match=r"MiB of memory.*t\.parquet"):
        read_path_file(path, EgoPath(np.arange(3.0), np.arange(3.0), poses))


def test_bounded_tables_are_those_of_arrow(tmp_path: Path) -> None:
    path = tmp_path / "t.parquet"
    write_table(path, TABLE, {"x": np.arange(5), "text": ["a", "a", "", "ä", "a"]}, {"size": "3"})
    assert read_bounded_table(path, FOR_COLUMNS).equals(pq.read_table(path), check_metadata=True)
    generous = MemoryBound(0, file_ratio=1000, value_bytes=1, row_bytes=0)
    assert read_bounded_table(path, generous, ["text"]).equals(pq.read_table(path, columns=["text"]))


def test_columns_that_are_named_twice_are_measured_by_the_name_that_counts(tmp_path: Path) -> None:
    path = tmp_path / "t.parquet"
    write_table(path, TABLE, {"x": np.arange(5), "text": ["a", "a", "", "b", "a"]})
    data = path.read_bytes()
    footer = data.find(b"genre.table")
    places = [k for k in range(footer) if data.startswith(b"\x04text", k)]
    # The schema says "text", and what lies beside the column's bytes says "next".
    assert len(places) == 2
    path.write_bytes(data[: places[1]] + b"\x04next" + data[places[1] + 5 :])
    assert pq.read_metadata(path).row_group(0).column(1).path_in_schema == "next"
    assert read_bounded_table(path, FOR_COLUMNS).column("text").to_pylist() == ["a", "a", "", "b", "a"]


@pytest.mark.parametrize("place", ["value", "metadata"])
def test_texts_of_tables_are_utf8(tmp_path: Path, place: str) -> None:
    texts = pa.array([b"\xff" if place == "value" else b"x"]).view(pa.string())
    metadata = dict(TABLE.metadata) | ({b"k": b"\xff"} if place == "metadata" else {})
    table = pa.Table.from_arrays([pa.array([1]), texts], schema=TABLE.with_metadata(metadata))
    pq.write_table(table, tmp_path / "t.parquet")
    with pytest.raises(ArtifactCorruptError, match=r"t\.parquet"):
        read_table(tmp_path / "t.parquet", TABLE)


@pytest.mark.parametrize(
    "value", [{"layers_per_block": 10**9}, {"block_out_channels": [4096] * 4}, {"norm_num_groups": 0}]
)
def test_fixers_larger_than_their_file_are_refused(tmp_path: Path, value: dict[str, Any]) -> None:
    from genre_tasks.fixer.weights import load_fnet
    from genre_tasks.weights import resolve_weights

    shipped = resolve_weights("fnet", "builtin")
    (tmp_path / "fnet.safetensors").write_bytes(shipped.read_bytes())
    document = json.loads(shipped.with_suffix(".json").read_text())
    document["architecture"]["vae"] |= value
    (tmp_path / "fnet.json").write_text(json.dumps(document))
    with pytest.raises(InputError, match="does not describe a fixer"):
        load_fnet(tmp_path / "fnet.safetensors")


def test_pictures_of_pairs_may_not_differ_in_size(tmp_path: Path) -> None:
    table = get_codec("pairs").TABLE  # type: ignore[attr-defined]
    sizes = iter(range(4, 100))
    columns = {field.name: [field.name] * 2 for field in table}
    columns["shift_m"] = np.zeros(2, np.float32)
    for field in table:
        if pa.types.is_large_binary(field.type):
            columns[field.name] = [_pack_png(s, 4, bytes(4 * (3 * s + 1))) for s in (next(sizes), next(sizes))]
    write_table(tmp_path / "pairs.parquet", table, columns)
    with pytest.raises(ArtifactCorruptError, match="pictures of sizes"):
        get_codec("pairs").read(tmp_path)


@pytest.mark.parametrize("text", ["[]", "3", '"x"', "{", "[" * 100_000])
def test_lists_of_etags_that_are_none_are_not_believed(text: str) -> None:
    bucket = SimpleNamespace(read=lambda name: SimpleNamespace(data=text.encode()))
    manifest = parse_manifest(fuzz_samples.make_manifests()[0], Path("manifest.json"))
    assert Payloads._read_etags(SimpleNamespace(_bucket=bucket), manifest) == {}  # type: ignore[arg-type]
