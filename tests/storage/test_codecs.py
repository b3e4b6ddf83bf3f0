"""Round trips of every kind, exact for floats; strict checks of schema, channels and shapes."""

from __future__ import annotations

import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import array_shapes, arrays

from genre_tasks.errors import ArtifactCorruptError, ConfigError, NonFiniteError
from genre_tasks.scene.graph import DEFAULT_SH_DEGREE, SH_COUNTS
from storage.codecs import KINDS, get_codec, tables
from storage.codecs.exr import read_channels, write_channels, write_exr
from storage.codecs.png import read_png, write_png
from storage.codecs.scene_tables import GAUSSIANS
from tests.storage import artifact_values as values
from tests.storage.artifact_values import COLORS, assert_same

SOME = settings(max_examples=12, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
seeds = st.integers(0, 2**32 - 1)


@pytest.fixture
def fresh(tmp_path_factory: pytest.TempPathFactory):
    return lambda: tmp_path_factory.mktemp("artifact")


def assert_survives_writing(kind: str, value: object, folder: Path) -> None:
    codec = get_codec(kind)
    codec.write(folder, value)
    assert_same(value, codec.read(folder, codec.measurements(value)), kind, COLORS)


@SOME
@given(seed=seeds, frames=st.integers(0, 3), actors=st.integers(0, 3), count=st.integers(0, 9))
def test_chunk(fresh, seed: int, frames: int, actors: int, count: int) -> None:
    assert_survives_writing("chunk", values.chunk(np.random.default_rng(seed), frames, actors, count), fresh())


@SOME
@given(seed=seeds, count=st.integers(0, 9), actors=st.integers(0, 3), snapshots=st.integers(0, 3))
def test_reconstruction(fresh, seed: int, count: int, actors: int, snapshots: int) -> None:
    value = values.reconstruction(np.random.default_rng(seed), count, actors, snapshots)
    assert_survives_writing("reconstruction", value, fresh())


@SOME
@given(seed=seeds, count=st.integers(0, 2), width=st.integers(1, 20), height=st.integers(1, 20))
def test_novel_views(fresh, seed: int, count: int, width: int, height: int) -> None:
    assert_survives_writing(
        "novel_views", values.novel_views(np.random.default_rng(seed), count, width, height), fresh()
    )


@SOME
@given(seed=seeds, count=st.integers(0, 2), width=st.integers(1, 20), height=st.integers(1, 20))
def test_fixed_views(fresh, seed: int, count: int, width: int, height: int) -> None:
    assert_survives_writing(
        "fixed_views", values.fixed_views(np.random.default_rng(seed), count, width, height), fresh()
    )


@SOME
@given(seed=seeds, count=st.integers(0, 3))
def test_evaluation(fresh, seed: int, count: int) -> None:
    assert_survives_writing("evaluation", values.evaluation(np.random.default_rng(seed), count), fresh())


@SOME
@given(z=arrays(np.float32, array_shapes(min_dims=2, max_dims=2, max_side=30), elements=st.floats(0, 1e6, width=32)))
def test_depth_is_exact_to_a_thousand_kilometres(fresh, z: np.ndarray) -> None:
    path = fresh() / "z.exr"
    write_channels(path, {"Z": z})
    assert read_channels(path, {"Z": np.float32}, z.shape)["Z"].tobytes() == z.tobytes()


@SOME
@given(
    single=arrays(np.float32, st.integers(0, 50), elements=st.floats(width=32)),
    double=arrays(np.float64, st.integers(0, 50), elements=st.floats()),
)
def test_parquet_keeps_every_bit_of_a_float(fresh, single: np.ndarray, double: np.ndarray) -> None:
    for kind, array in ((pa.float32(), single), (pa.float64(), double)):
        declared = tables.schema("t/1", [tables.column("v", kind, "any")])
        path = fresh() / "t.parquet"
        tables.write_table(path, declared, {"v": array})
        assert tables.column_array(tables.read_table(path, declared)[0], "v").tobytes() == array.tobytes()


def test_tensors_read_back_are_contiguous_and_writable(tmp_path: Path) -> None:
    codec = get_codec("reconstruction")
    codec.write(tmp_path, values.make("reconstruction"))
    g = codec.read(tmp_path).scene.gaussians
    for tensor in (g.means, g.log_scales, g.quats, g.logit_opacities, g.colors):
        assert tensor.is_contiguous() and tensor.dtype == torch.float32
    g.means.add_(1)


def test_gaussians_columns_are_named_and_documented(tmp_path: Path) -> None:
    get_codec("reconstruction").write(tmp_path, values.make("reconstruction"))
    found = pq.read_schema(tmp_path / "gaussians.parquet")
    assert found.names == [
        "x",
        "y",
        "z",
        "log_scale_x",
        "log_scale_y",
        "log_scale_z",
        "quat_w",
        "quat_x",
        "quat_y",
        "quat_z",
        "logit_opacity",
        "red",
        "green",
        "blue",
        "node",
    ]
    assert found.field("x").metadata[b"note"] == b"metres"
    assert sorted(p.name for p in (tmp_path / "snapshots").iterdir()) == [
        "iteration_0008.parquet",
        "iteration_0016.parquet",
    ]
    scene = values.make("reconstruction").scene
    x = pq.read_table(tmp_path / "gaussians.parquet")["x"].to_numpy()
    assert np.array_equal(x, scene.gaussians.means[:, 0].numpy())


def test_harmonics_lie_beside_the_gaussians_and_old_artifacts_have_none(tmp_path: Path) -> None:
    value, codec = values.make("reconstruction"), get_codec("reconstruction")
    (tmp_path / "old").mkdir()
    codec.write(tmp_path / "old", value)
    assert (
        not (tmp_path / "old" / "harmonics").exists() and codec.read(tmp_path / "old").scene.spherical_harmonics is None
    )
    waves = torch.randn(13, SH_COUNTS[DEFAULT_SH_DEGREE], 3, generator=torch.Generator().manual_seed(0))
    assert len(value.scene) == 13
    snapshots = {
        n: s.with_spherical_harmonics(torch.full((len(s), SH_COUNTS[DEFAULT_SH_DEGREE], 3), float(n)))
        for n, s in value.snapshots.items()
    }
    glossy = replace(value, scene=value.scene.with_spherical_harmonics(waves), snapshots=snapshots)
    (tmp_path / "new").mkdir()
    codec.write(tmp_path / "new", glossy)
    back = codec.read(tmp_path / "new")
    assert torch.equal(back.scene.spherical_harmonics, waves)
    assert {n: float(s.spherical_harmonics.mean()) for n, s in back.snapshots.items()} == {8: 8.0, 16: 16.0}
    names = pq.read_schema(tmp_path / "new" / "harmonics" / "gaussians.parquet").names
    assert names[:4] == ["red_1", "green_1", "blue_1", "red_2"]
    (tmp_path / "bad").mkdir()
    with pytest.raises(ConfigError, match=r"harmonics of gaussians.parquet is float32 \[13, 5, 3\]"):
        codec.write(tmp_path / "bad", replace(value, scene=value.scene.with_spherical_harmonics(torch.zeros(13, 5, 3))))
    for degree, count in SH_COUNTS.items():
        # A scene of another program has the degree of its file.
        folder = tmp_path / f"degree {degree}"
        folder.mkdir()
        coefficients = torch.randn(13, count, 3, generator=torch.Generator().manual_seed(degree))
        codec.write(folder, replace(value, scene=value.scene.with_spherical_harmonics(coefficients), snapshots={}))
        assert torch.equal(codec.read(folder).scene.spherical_harmonics, coefficients)
    (tmp_path / "new" / "harmonics" / "iteration_0008.parquet").unlink()
    with pytest.raises(ArtifactCorruptError, match="A table is missing"):
        codec.read(tmp_path / "new")


def test_images_of_a_chunk_lie_uncompressed_as_they_came(tmp_path: Path) -> None:
    value = values.make("chunk")
    get_codec("chunk").write(tmp_path, value)
    data = (tmp_path / "views.parquet").read_bytes()
    assert all(v.image in data for v in value.views)


def _rewrite(path: Path, change) -> None:
    table = change(pq.read_table(path))
    path.unlink()
    pq.write_table(table, path)


def _as_double(t: pa.Table) -> pa.Table:
    fields = [f.with_type(pa.float64()) if f.name == "z" else f for f in t.schema]
    return t.cast(pa.schema(fields, t.schema.metadata))


def _with_nulls(t: pa.Table) -> pa.Table:
    return t.set_column(3, pa.field("log_scale_x", pa.float32()), pa.array([None] * t.num_rows, pa.float32()))


def _with_node_99(t: pa.Table) -> pa.Table:
    return t.set_column(14, t.schema.field("node"), pa.array([99] * t.num_rows))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda t: t.drop_columns(["quat_w"]), "Column 'quat_w' is missing"),
        (lambda t: t.append_column("sh", t["x"]), "Column 'sh' is unexpected"),
        (_as_double, "Column 'z' is double, expected float"),
        (_with_nulls, "Column 'log_scale_x' holds nulls"),
        (lambda t: t.select(["y", "x", *t.column_names[2:]]), "another order"),
        (lambda t: t.replace_schema_metadata({"genre.table": "points/1"}), "'points/1', expected 'gaussians/1'"),
        (lambda t: t.replace_schema_metadata({}), "'unnamed', expected"),
        (_with_node_99, "Column 'node' holds 99"),
    ],
)
def test_a_table_of_another_schema_is_named(tmp_path: Path, change, message: str) -> None:
    codec = get_codec("reconstruction")
    codec.write(tmp_path, values.make("reconstruction"))
    _rewrite(tmp_path / "gaussians.parquet", change)
    with pytest.raises(ArtifactCorruptError, match=message) as caught:
        codec.read(tmp_path)
    assert caught.value.file == str(tmp_path / "gaussians.parquet")


def test_flipped_bits_in_pages_are_found_without_digests(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    columns = {f.name: rng.normal(size=4000).astype(f.type.to_pandas_dtype()) for f in GAUSSIANS}
    tables.write_table(tmp_path / "t.parquet", GAUSSIANS, columns)
    data = (tmp_path / "t.parquet").read_bytes()
    found, harmless = 0, 0
    for _ in range(60):
        flipped = bytearray(data)
        flipped[int(rng.integers(len(data)))] ^= 1 << int(rng.integers(8))
        (tmp_path / "t.parquet").write_bytes(flipped)
        try:
            table, _ = tables.read_table(tmp_path / "t.parquet", GAUSSIANS)
            harmless += all(np.array_equal(tables.column_array(table, k), v) for k, v in columns.items())
        except ArtifactCorruptError:
            found += 1
    assert found + harmless == 60 and found >= 57


def test_truncated_and_foreign_exr_are_named(tmp_path: Path) -> None:
    path = tmp_path / "a.exr"
    rng = np.random.default_rng(0)
    channels = {c: rng.random((40, 30)).astype(np.float16) for c in "RGB"}
    dtypes = dict.fromkeys("RGB", np.float16)
    write_channels(path, channels)
    data = path.read_bytes()
    for size in (0, 3, 100, 320, len(data) // 2, len(data) - 1):
        path.write_bytes(data[:size])
        with pytest.raises(ArtifactCorruptError, match=r"a\.exr"):
            read_channels(path, dtypes, (40, 30))
    path.write_bytes(data)
    with pytest.raises(ArtifactCorruptError, match=r"channels \['B', 'G', 'R'\], expected \['A'"):
        read_channels(path, dtypes | {"A": np.float16}, (40, 30))
    with pytest.raises(ArtifactCorruptError, match="Channel R is float16"):
        read_channels(path, dict.fromkeys("RGB", np.float32), (40, 30))
    with pytest.raises(ArtifactCorruptError, match=r"\(40, 30\), expected"):
        read_channels(path, dtypes, (30, 40))
    path.unlink()
    with pytest.raises(ArtifactCorruptError, match="missing"):
        read_channels(path, dtypes, (40, 30))


def test_exr_bytes_do_not_depend_on_time_or_order(tmp_path: Path) -> None:
    channels = {c: np.full((300, 200), k, np.float32) for k, c in enumerate("ZAB")}
    write_channels(tmp_path / "a.exr", channels)
    write_channels(tmp_path / "b.exr", dict(reversed(channels.items())))
    assert (tmp_path / "a.exr").read_bytes() == (tmp_path / "b.exr").read_bytes()


def test_a_forked_child_can_write_too(tmp_path: Path) -> None:
    """OpenEXR's threads do not survive a fork; without care the child waits for them for ever."""
    # in a process of its own: what other tests started here would come along in the fork
    script = """
import multiprocessing, sys
from pathlib import Path
import numpy as np
from storage.codecs.exr import write_channels

folder = Path(sys.argv[1])
channels = {"Z": np.random.default_rng(0).random((400, 300)).astype(np.float32)}
write_channels(folder / "parent.exr", channels)
child = multiprocessing.get_context("fork").Process(target=write_channels, args=(folder / "child.exr", channels))
child.start()
child.join(60)
alive = child.is_alive()
child.kill()
write_channels(folder / "again.exr", channels)
sys.exit(alive or child.exitcode)
"""
    done = subprocess.run(
        [sys.executable, "-c", script, str(tmp_path)],
        env=os.environ | {"PYTHONPATH": str(Path(__file__).resolve().parents[2])},
        check=False,
    )
    assert done.returncode == 0
    one, two, three = ((tmp_path / f"{name}.exr").read_bytes() for name in ("parent", "child", "again"))
    assert one == two == three


def test_one_image_for_others(tmp_path: Path) -> None:
    color, depth = np.full((4, 6, 3), 0.5, np.float32), np.full((4, 6), 1e5, np.float32)
    write_exr(tmp_path / "x.exr", color, np.ones((4, 6), np.float32), depth)
    dtypes = dict.fromkeys("RGB", np.float16) | dict.fromkeys("AZ", np.float32)
    back = read_channels(tmp_path / "x.exr", dtypes, (4, 6))
    assert back["R"][0, 0] == np.float16(0.21404114) and np.array_equal(back["Z"], depth)


@pytest.mark.parametrize("layer", ["color", "lidar_color"])
def test_light_above_half_is_an_error_and_not_clamped(tmp_path: Path, layer: str) -> None:
    value = values.make("novel_views")
    getattr(value, layer)[1, 0, 2, 1] = 150.0
    (value.alpha if layer == "color" else value.lidar_alpha)[1, 0, 2] = 1.0
    with pytest.raises(NonFiniteError, match=r"scene-linear, as half\) holds 1 .*\(0, 2, 1\)"):
        get_codec("novel_views").write(tmp_path, value)


def test_values_that_break_a_contract_are_refused(tmp_path: Path) -> None:
    from dataclasses import replace

    chunk = values.make("chunk")
    wide = replace(chunk.static, positions=chunk.static.positions.astype(np.float64))
    with pytest.raises(ConfigError, match=r"positions of node 0 is float64 \[11, 3\], expected float32 \['N', 3\]"):
        get_codec("chunk").write(tmp_path, replace(chunk, static=wide))
    scene = values.make("reconstruction")
    scene.scene.gaussians.means[4, 1] = float("inf")
    with pytest.raises(NonFiniteError, match=r"gaussians of gaussians.parquet holds 1 .*\(4, 1\)"):
        get_codec("reconstruction").write(tmp_path, scene)
    picture = replace(values.make("evaluation"), pictures={"../x": np.zeros((2, 2, 3), np.uint8)})
    (tmp_path / "e").mkdir()
    with pytest.raises(ConfigError, match="cannot be a file's name"):
        get_codec("evaluation").write(tmp_path / "e", picture)


def test_png(tmp_path: Path) -> None:
    image = np.random.default_rng(0).integers(0, 256, (9, 5, 3), dtype=np.uint8)
    write_png(tmp_path / "a.png", image)
    assert np.array_equal(read_png(tmp_path / "a.png"), image)
    (tmp_path / "a.png").write_bytes((tmp_path / "a.png").read_bytes()[:60])
    with pytest.raises(ArtifactCorruptError, match="does not decode"):
        read_png(tmp_path / "a.png")
    with pytest.raises(ConfigError, match="float32"):
        write_png(tmp_path / "b.png", image.astype(np.float32))


def test_every_kind_has_a_maker() -> None:
    assert set(KINDS) == set(values.MAKERS)
