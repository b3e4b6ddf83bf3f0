"""What every format must do. Inherit :class:`FormatSuite` and set its attributes."""

from __future__ import annotations

import tempfile
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from genre_tasks.errors import InputError
from genre_tasks.exchange.checks import CLOUD_ATTRIBUTES
from genre_tasks.exchange.cloud_errors import CloudErrors, compare_clouds
from genre_tasks.exchange.one_cloud import make_resting_scene
from genre_tasks.exchange.registry import find_format, load_format
from genre_tasks.exchange.types import ExchangeFormat, ExchangeScene, SplatCloud
from tests.exchange.splat_clouds import change_one, is_finite, make_cloud, make_driving_scene, same_bits

EXACT = CloudErrors(0, 0, 0, 0, 0, 0)
CUTS = 50
FLIPS = 60

EXTREMES = (
    ("means", 1e30),
    ("means", -4e4),
    ("log_scales", 80.0),
    ("log_scales", -80.0),
    ("log_scales", 120.0),
    ("log_scales", -200.0),
    ("quats", 1e-12),
    ("quats", 1e12),
    ("logit_opacities", 90.0),
    ("logit_opacities", -90.0),
    ("sh_dc", 1e4),
    ("sh_dc", -1e4),
    ("sh_rest", 1e4),
    ("sh_rest", -1e4),
)


class FormatSuite:
    """Contract tests.

    Attributes:
        name: of the format in the registry.
        tolerances: largest errors of a round trip of :func:`make_cloud`.
        sh_degrees: those that a file can hold.
        keeps_bits: whether a round trip gives the same bits.
        keeps_antialiasing: whether a file says that it was made with anti-aliasing.
        cut_attributes: those that are cut to a range, which ``describe_losses`` must say.
        relative: allowed error per size of an extreme value, above the tolerances.
    """

    name: str
    tolerances: CloudErrors = EXACT
    sh_degrees: tuple[int, ...] = (0, 1, 2, 3, 4)
    keeps_bits: bool = False
    keeps_antialiasing: bool = True
    cut_attributes: frozenset[str] = frozenset()
    relative: float = 1e-6

    @property
    def format(self) -> ExchangeFormat:
        return load_format(self.name)

    @property
    def highest(self) -> int:
        return max(self.sh_degrees)

    def file(self, folder: Path, stem: str = "scene") -> Path:
        return folder / f"{stem}{self.format.suffixes[0]}"

    def write(self, path: Path, cloud: SplatCloud) -> None:
        """Replaced where the format itself does not write."""
        self.format.write(path, make_resting_scene(cloud))

    def read(self, path: Path) -> SplatCloud:
        scene = self.format.read(path)
        assert len(scene.nodes) == 1 and scene.nodes[0].motion is None
        return scene.nodes[0].cloud

    def assert_same(self, before: SplatCloud, after: SplatCloud) -> None:
        assert len(after) == len(before)
        assert after.sh_degree == before.sh_degree
        errors = compare_clouds(before, after)
        assert not errors.exceed(self.tolerances), errors
        if self.keeps_bits:
            assert same_bits(before, after)

    # --- what the format says of itself

    def test_the_registry_finds_it(self, tmp_path: Path) -> None:
        assert self.format.name == self.name
        for suffix in self.format.suffixes:
            assert suffix == suffix.lower()
            assert find_format(tmp_path / f"Scene{suffix.upper()}") is self.format

    def test_losses_are_sentences(self) -> None:
        for scene in (make_resting_scene(make_cloud(3, self.highest)), make_driving_scene(self.highest)):
            for loss in self.format.describe_losses(scene):
                assert loss.endswith(".") and loss[0].isupper() and len(loss.split()) <= 30

    # --- round trips

    @pytest.mark.parametrize("count", [0, 1, 2, 255, 256, 257, 1000])
    def test_round_trip_of_any_count(self, tmp_path: Path, count: int) -> None:
        cloud = make_cloud(count, self.highest)
        self.write(self.file(tmp_path), cloud)
        self.assert_same(cloud, self.read(self.file(tmp_path)))

    def test_round_trip_of_any_degree(self, tmp_path: Path) -> None:
        for degree in self.sh_degrees:
            cloud = make_cloud(30, degree, seed=degree)
            self.write(self.file(tmp_path), cloud)
            self.assert_same(cloud, self.read(self.file(tmp_path)))

    def test_round_trip_of_random_clouds(self) -> None:
        # The search is a function of its own: an inherited method would be searched once for all formats.
        @settings(max_examples=15, deadline=None)
        @given(seed=st.integers(0, 2**32 - 1), count=st.integers(0, 40), extent_m=st.floats(0.01, 500))
        def search(seed: int, count: int, extent_m: float) -> None:
            degree = self.sh_degrees[seed % len(self.sh_degrees)]
            cloud = make_cloud(count, degree, seed, extent_m)
            with tempfile.TemporaryDirectory() as folder:
                self.write(self.file(Path(folder)), cloud)
                self.assert_same(cloud, self.read(self.file(Path(folder))))

        search()

    @pytest.mark.parametrize("antialiased", [True, False, None])
    def test_antialiasing(self, tmp_path: Path, antialiased: bool | None) -> None:
        cloud = replace(make_cloud(3), antialiased=antialiased)
        self.write(self.file(tmp_path), cloud)
        found = self.read(self.file(tmp_path)).antialiased
        if self.keeps_antialiasing:
            # Some files have a bit for it, and cannot leave it open.
            assert bool(found) == bool(antialiased)
        else:
            assert found is None
            if antialiased and self.format.can_write:
                assert len(self.losses_of(cloud)) > len(self.losses_of(replace(cloud, antialiased=False)))

    def losses_of(self, cloud: SplatCloud) -> tuple[str, ...]:
        return self.format.describe_losses(make_resting_scene(cloud))

    def test_a_higher_degree_is_refused_or_a_loss(self, tmp_path: Path) -> None:
        for degree in set(range(5)) - set(self.sh_degrees):
            cloud = make_cloud(3, degree)
            if self.format.can_write:
                assert len(self.losses_of(cloud)) > len(self.losses_of(make_cloud(3, 0)))
                self.write(self.file(tmp_path), cloud)
                assert self.read(self.file(tmp_path)).sh_degree in self.sh_degrees

    def test_the_same_scene_gives_the_same_bytes(self, tmp_path: Path) -> None:
        for stem in ("one", "two"):
            self.write(self.file(tmp_path, stem), make_cloud(50, self.highest))
        assert self.file(tmp_path, "one").read_bytes() == self.file(tmp_path, "two").read_bytes()

    def test_an_existing_file_is_replaced(self, tmp_path: Path) -> None:
        self.file(tmp_path).write_bytes(b"x" * 100_000)
        self.write(self.file(tmp_path), make_cloud(2))
        assert len(self.read(self.file(tmp_path))) == 2

    def test_what_was_read_needs_the_file_no_more(self, tmp_path: Path) -> None:
        cloud = make_cloud(40, self.highest)
        self.write(self.file(tmp_path), cloud)
        found = self.read(self.file(tmp_path))
        with self.file(tmp_path).open("r+b") as stream:
            stream.write(b"\xff" * self.file(tmp_path).stat().st_size)
        self.assert_same(cloud, found)

    # --- values at the ends of ranges

    @pytest.mark.parametrize(("attribute", "value"), EXTREMES)
    def test_extreme_values_are_kept_or_refused(self, tmp_path: Path, attribute: str, value: float) -> None:
        degree = self.highest
        if attribute == "sh_rest" and not degree:
            return
        cloud = change_one(make_cloud(4, degree), attribute, value)
        try:
            self.write(self.file(tmp_path), cloud)
        except InputError as error:
            assert error.file == str(self.file(tmp_path))
            return
        found = self.read(self.file(tmp_path))
        if attribute in self.cut_attributes:
            assert len(self.losses_of(cloud)) > len(self.losses_of(make_cloud(4, degree)))
            return
        allowed = {name: tolerance + self.relative * abs(value) for name, tolerance in vars(self.tolerances).items()}
        errors = compare_clouds(cloud, found)
        assert not errors.exceed(CloudErrors(**allowed)), errors

    @pytest.mark.parametrize("attribute", CLOUD_ATTRIBUTES)
    @pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
    def test_values_that_are_not_finite_are_not_written(self, tmp_path: Path, attribute: str, value: float) -> None:
        if not self.format.can_write:
            return
        cloud = change_one(make_cloud(4, self.highest or 1), attribute, value, row=2)
        with pytest.raises(InputError, match=rf"{attribute}.*2") as caught:
            self.write(self.file(tmp_path), cloud)
        assert caught.value.file == str(self.file(tmp_path))

    # --- files that are not sound

    def test_no_file(self, tmp_path: Path) -> None:
        tmp_path.joinpath(f"folder{self.format.suffixes[0]}").mkdir()
        for stem in ("none", "folder"):
            with pytest.raises(InputError) as caught:
                self.format.read(self.file(tmp_path, stem))
            assert caught.value.file == str(self.file(tmp_path, stem))

    def test_a_file_that_is_cut_off(self, tmp_path: Path) -> None:
        cloud = make_cloud(20, self.highest)
        self.write(self.file(tmp_path), cloud)
        complete = self.file(tmp_path).read_bytes()
        found = self.read(self.file(tmp_path))
        cuts = np.unique(np.linspace(0, len(complete) - 1, CUTS).astype(int))
        for size in cuts.tolist():
            self.file(tmp_path).write_bytes(complete[:size])
            scene = self.assert_read_or_refused(self.file(tmp_path))
            # A file without a header may be a shorter sound one.
            for node in scene.nodes if scene is not None else ():
                assert same_bits(node.cloud, found.select(slice(0, len(node.cloud)))), size

    def test_flipped_bytes(self, tmp_path: Path) -> None:
        self.write(self.file(tmp_path), make_cloud(20, self.highest))
        complete = self.file(tmp_path).read_bytes()
        random = np.random.default_rng(5)
        # Half of them in the beginning, where headers are.
        places = [
            *random.integers(0, min(len(complete), 400), FLIPS // 2),
            *random.integers(0, len(complete), FLIPS // 2),
        ]
        for place in places:
            damaged = bytearray(complete)
            damaged[place] ^= int(random.integers(1, 256))
            self.file(tmp_path).write_bytes(bytes(damaged))
            self.assert_read_or_refused(self.file(tmp_path))

    def test_garbage(self) -> None:
        @settings(max_examples=40, deadline=None)
        @given(garbage=st.binary(max_size=600), start=st.integers(0, 200))
        def search(garbage: bytes, start: int) -> None:
            with tempfile.TemporaryDirectory() as folder:
                path = self.file(Path(folder))
                path.write_bytes(garbage)
                self.assert_read_or_refused(path)
                path.write_bytes(sound[:start] + garbage)
                self.assert_read_or_refused(path)

        with tempfile.TemporaryDirectory() as folder:
            self.write(self.file(Path(folder)), make_cloud(2))
            sound = self.file(Path(folder)).read_bytes()
        search()

    def assert_read_or_refused(self, path: Path) -> ExchangeScene | None:
        """Reads a file; what is not refused must be finite. Any other exception fails the test."""
        try:
            scene = self.format.read(path)
        except InputError as error:
            assert error.file == str(path)
            return None
        assert is_finite(scene)
        return scene

    # --- several nodes

    def test_nodes(self, tmp_path: Path) -> None:
        scene = make_driving_scene(self.highest)
        if not self.format.can_write:
            return
        if not self.format.carries_nodes:
            with pytest.raises(InputError, match="4 parts"):
                self.format.write(self.file(tmp_path), scene)
            assert any("2 actors" in loss for loss in self.format.describe_losses(scene))
            return
        self.format.write(self.file(tmp_path), scene)
        found = self.format.read(self.file(tmp_path))
        np.testing.assert_allclose(found.times_s, scene.times_s, atol=1e-6)
        after: Mapping[str, object] = {node.name: node for node in found.nodes}
        assert sorted(after) == sorted(node.name for node in scene.nodes)
        for before, node in ((b, n) for b in scene.nodes for n in found.nodes if n.name == b.name):
            self.assert_same(before.cloud, node.cloud)
            assert (node.motion is None) == (before.motion is None)
            if before.motion is not None and node.motion is not None:
                there = before.motion.present
                np.testing.assert_array_equal(node.motion.present, there)
                poses = node.motion.scene_SE3_node
                np.testing.assert_allclose(poses[there], before.motion.scene_SE3_node[there], atol=1e-5)

    def test_words_of_nodes(self, tmp_path: Path) -> None:
        if not self.format.carries_nodes:
            return
        scene = make_driving_scene()
        self.format.write(self.file(tmp_path), scene)
        found = self.format.read(self.file(tmp_path))
        assert found.frames == scene.frames
        np.testing.assert_allclose(found.world_SE3_scene, scene.world_SE3_scene, atol=1e-9)
        after = {node.name: node for node in found.nodes}
        for node in scene.nodes:
            assert (after[node.name].label, after[node.name].track_id) == (node.label, node.track_id)
            np.testing.assert_allclose(after[node.name].size_m, node.size_m, rtol=1e-6)
