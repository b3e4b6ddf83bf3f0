"""What lies in a sequence folder under other names: it is read where it can be, and named where it cannot."""

from __future__ import annotations

import bz2
import gzip
import lzma
import os
import shutil
import zipfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from genre_tasks.errors import InputError
from genre_tasks.logs.findings import Finding
from genre_tasks.logs.pandaset.reader import PandaSetLog, open_pandaset
from genre_tasks.logs.pandaset.writer import write_pandaset
from tests.logs.pandaset_folder import FRAMES, small_log
from tests.ordinary_user import as_ordinary_user


@pytest.fixture(scope="module")
def written(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_pandaset(small_log(), tmp_path_factory.mktemp("source") / "002")


@pytest.fixture
def folder(written: Path, tmp_path: Path) -> Path:
    shutil.copytree(written, tmp_path / "002")
    return tmp_path / "002"


def opened(folder: Path) -> PandaSetLog:
    return open_pandaset(str(folder))


def findings(folder: Path) -> dict[str, Finding]:
    return {finding.word: finding for finding in opened(folder).findings()}


def images(folder: Path) -> list[Path]:
    return sorted(folder.glob("camera/*/*.png"))


def tables(folder: Path) -> list[Path]:
    return sorted(folder.glob("**/*.pkl.gz"))


def convert(folder: Path, suffix: str) -> None:
    for path in images(folder):
        Image.open(path).save(path.with_suffix(suffix), lossless=True)
        path.unlink()


def pack(folder: Path, suffix: str) -> None:
    """Writes all tables with another compression."""
    for path in tables(folder):
        data = gzip.decompress(path.read_bytes())
        target = path.with_name(path.name.removesuffix(".pkl.gz") + suffix)
        if suffix.endswith(".zip"):
            with zipfile.ZipFile(target, "w", zipfile.ZIP_DEFLATED) as archive:
                archive.writestr("table.pkl", data)
        else:
            compress = {".bz2": bz2.compress, ".xz": lzma.compress}.get(target.suffix, bytes)
            target.write_bytes(compress(data))
        path.unlink()


def widen(folder: Path, digits: int) -> None:
    for path in [*images(folder), *tables(folder)]:
        path.rename(path.with_name(path.name.zfill(len(path.name) + digits)))


def capitalise(folder: Path) -> None:
    for name in ("camera", "lidar", "annotations/cuboids", "annotations"):
        (folder / name).rename((folder / name).with_name(Path(name).name.capitalize()))


SPELLINGS: dict[str, Callable[[Path], None]] = {
    "suffix in capitals": lambda f: [p.rename(p.with_suffix(".PNG")) for p in images(f)] and None,
    "webp": lambda f: convert(f, ".webp"),
    "tif": lambda f: convert(f, ".tif"),
    "bmp": lambda f: convert(f, ".bmp"),
    "three digits": lambda f: widen(f, 1),
    "six digits": lambda f: widen(f, 4),
    "one digit": lambda f: [p.rename(p.with_name(p.name[1:])) for p in [*images(f), *tables(f)]] and None,
    "pkl": lambda f: pack(f, ".pkl"),
    "pickle": lambda f: pack(f, ".pickle"),
    "bz2": lambda f: pack(f, ".pkl.bz2"),
    "xz": lambda f: pack(f, ".pkl.xz"),
    "zip": lambda f: pack(f, ".pkl.zip"),
    "folders in capitals": capitalise,
    "settings in capitals": lambda f: [p.rename(p.with_name(p.name.title())) for p in f.glob("*/*/*.json")] and None,
}


class TestSpellings:
    @pytest.mark.parametrize("kind", SPELLINGS)
    def test_other_spellings_are_the_same_log(self, folder: Path, written: Path, kind: str) -> None:
        """Report: scaleapi/pandaset-devkit#140 (pkl without gz); pytorch/vision#552 (suffixes in capitals)."""
        expected = opened(written)
        SPELLINGS[kind](folder)
        found = opened(folder)
        assert found.cameras == expected.cameras
        for frame in range(FRAMES):
            assert found.image_bytes("left", frame) is not None
            one, other = found.sweep(frame), expected.sweep(frame)
            assert one is not None and other is not None
            np.testing.assert_array_equal(one.points_world, other.points_world)
        assert [t.frames.tolist() for t in found.tracks()] == [t.frames.tolist() for t in expected.tracks()]
        assert len(found.tracks()) > 0
        assert {finding.severity for finding in found.findings()} <= {"note"}

    def test_a_sound_log_has_no_findings(self, written: Path) -> None:
        assert opened(written).findings() == ()

    def test_pandaset_as_published_has_no_findings(self, folder: Path) -> None:
        (folder / "annotations/semseg").mkdir()
        (folder / "annotations/semseg/00.pkl.gz").write_bytes(b"")
        (folder / "LICENSE.txt").write_text("CC BY 4.0")
        assert opened(folder).findings() == ()

    def test_cuboids_alone_without_gzip(self, folder: Path, written: Path) -> None:
        """Report: scaleapi/pandaset-devkit#140."""
        for path in folder.glob("annotations/cuboids/*.gz"):
            path.with_suffix("").write_bytes(gzip.decompress(path.read_bytes()))
            path.unlink()
        assert len(opened(folder).tracks()) == len(opened(written).tracks()) > 0


class TestLitter:
    NAMES = (".DS_Store", "._00.png", "Thumbs.db", "desktop.ini", "00.png~", ".00.pkl.gz.swp", "x.tmp", ".git")

    def test_litter_changes_nothing(self, folder: Path, written: Path) -> None:
        """Report: pytorch/vision#109 (hidden files taken for data)."""
        for place in (".", "camera", "camera/left", "lidar", "annotations", "annotations/cuboids"):
            for name in self.NAMES:
                (folder / place / name).write_bytes(b"\0\0\0\1")
            (folder / place / "__MACOSX").mkdir()
        assert opened(folder).findings() == ()
        assert opened(folder).digest() == opened(written).digest()

    def test_what_results_repeat_is_in_the_digest(self, folder: Path, written: Path) -> None:
        """Report: none found; case 24 of the list of odd logs."""
        (folder / "camera/left/01 copy.png").write_bytes(b"")
        assert findings(folder)["unread_files"].severity == "note"
        assert opened(folder).digest() == opened(written).digest()
        (folder / "camera/left/09.png").write_bytes(b"")
        assert findings(folder)["files_without_frame"].severity == "warning"
        assert opened(folder).digest() != opened(written).digest()


class TestNamed:
    """What is not read is named, with what was expected."""

    def test_images_under_other_names(self, folder: Path) -> None:
        """Report: huggingface/datasets#4514 (suffixes that a loader passes over)."""
        for path in folder.glob("camera/left/*.png"):
            path.rename(path.with_name(f"frame_{path.stem}.png"))
        found = findings(folder)
        assert [c.name for c in opened(folder).cameras] == ["front"]
        assert found["camera_without_images"].camera == "left"
        assert "frame_00.png" in found["unread_files"].message and "00.jpg to 03.jpg" in found["unread_files"].message
        assert found["unread_files"].severity == "warning"

    def test_sweeps_in_another_format(self, folder: Path) -> None:
        for path in folder.glob("lidar/*.pkl.gz"):
            path.rename(path.with_name(path.name.replace(".pkl.gz", ".npz")))
        found = findings(folder)["unread_files"]
        assert found.severity == "warning" and "00.npz" in found.message and "00.pkl.gz" in found.message

    @pytest.mark.parametrize("name", ["cuboids", "labels", "annotations/boxes", "annotations/00.pkl.gz"])
    def test_cuboids_in_another_folder(self, folder: Path, name: str) -> None:
        """Report: scaleapi/pandaset-devkit#140 (annotations gone without a word)."""
        shutil.move(folder / "annotations/cuboids", folder / "kept")
        target = folder / name
        shutil.move(folder / "kept/00.pkl.gz" if target.suffix else folder / "kept", target)
        found = findings(folder)["unread_files"]
        assert found.severity == "warning"
        assert target.name in found.message and "annotations/cuboids/" in found.message

    @pytest.mark.parametrize("pattern", ["camera/left/*.png", "lidar/*.pkl.gz", "annotations/cuboids/*.pkl.gz"])
    def test_counted_from_one(self, folder: Path, pattern: str) -> None:
        """Report: noahzn/Lite-Mono#171 (frames that do not begin at 0)."""
        for path in sorted(folder.glob(pattern), reverse=True):
            stem, suffix = path.name.split(".", 1)
            path.rename(path.with_name(f"{int(stem) + 1:02d}.{suffix}"))
        found = findings(folder)["counted_from_one"]
        assert found.severity == "fatal" and f"from 1 to {FRAMES}" in found.message and found.remedy

    def test_frames_that_have_no_pose(self, folder: Path) -> None:
        shutil.copy(folder / "camera/left/00.png", folder / "camera/left/07.png")
        found = findings(folder)["files_without_frame"]
        assert (found.severity, found.camera) == ("warning", "left") and "7" in found.message

    def test_two_files_for_a_frame(self, folder: Path) -> None:
        before = opened(folder).image_bytes("left", 1)
        Image.new("RGB", (48, 32)).save(folder / "camera/left/001.png")
        shutil.copy(folder / "camera/left/02.png", folder / "camera/left/02.PNG")
        found = findings(folder)["ambiguous_file"]
        assert found.frames == (1, 2) and "001.png" in found.message
        assert opened(folder).image_bytes("left", 1) == before

    def test_a_camera_without_intrinsics(self, folder: Path) -> None:
        (folder / "camera/left/intrinsics.json").unlink()
        found = findings(folder)["camera_without_intrinsics"]
        assert (found.severity, found.camera, found.numbers["images"]) == ("warning", "left", FRAMES)

    def test_cuboids_of_some_frames(self, folder: Path) -> None:
        (folder / "annotations/cuboids/02.pkl.gz").unlink()
        assert findings(folder)["missing_cuboids"].frames == (2,)

    def test_links_that_lead_nowhere(self, folder: Path) -> None:
        for path in folder.glob("camera/left/*.png"):
            path.unlink()
            path.symlink_to("/nowhere/" + path.name)
        (folder / "lidar/01.pkl.gz").unlink()
        (folder / "lidar/01.pkl.gz").symlink_to("01.pkl.gz")
        log = opened(folder)
        messages = " ".join(finding.message for finding in log.findings())
        assert "00.png (a link that leads nowhere)" in messages and "01.pkl.gz (a link that leads nowhere)" in messages
        assert log.sweep(1) is None and len(log.digest()) == 64

    def test_a_folder_and_a_pipe_in_the_place_of_a_file(self, folder: Path) -> None:
        for name in ("camera/left/01.png", "camera/left/poses.json"):
            (folder / name).unlink()
        (folder / "camera/left/01.png").mkdir()
        os.mkfifo(folder / "camera/left/poses.json")
        log = opened(folder)
        assert "01.png/" in " ".join(finding.message for finding in log.findings())
        with pytest.raises(InputError, match="no file"):
            log.image_bytes("left", 0)
        assert log.image_bytes("front", 0)


class TestOpening:
    def test_a_folder_of_the_sequence(self, folder: Path) -> None:
        with pytest.raises(InputError, match=f"The folder above it is one: {folder}"):
            opened(folder / "camera")

    def test_a_file(self, folder: Path) -> None:
        with pytest.raises(InputError, match="a file and not a sequence folder"):
            opened(folder / "lidar/poses.json")

    @pytest.mark.parametrize("name", ["~nobody-of-that-name/002", "x" * 5000, "a\0b"])
    def test_names_that_the_system_refuses(self, name: str) -> None:
        with pytest.raises(InputError):
            open_pandaset(name)

    def test_a_folder_that_may_not_be_listed(self, folder: Path) -> None:
        """Report: nerfstudio-project/nerfstudio#1130 (files of another user)."""
        assert "unreadable_folder" not in findings(folder)
        with as_ordinary_user(folder) as copy:
            (copy / "camera/left").chmod(0)
            assert findings(copy)["unreadable_folder"].severity == "warning"
