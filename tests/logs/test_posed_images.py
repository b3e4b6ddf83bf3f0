"""Images with poses: the same street from every format, axes and units found, and errors that say what to do."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from genre_tasks.errors import ConfigError, InputError
from genre_tasks.logs.posed_images.colmap_model import read_colmap_model
from genre_tasks.logs.posed_images.frame_grouping import FrameGroups, group_frames
from genre_tasks.logs.posed_images.image_log import PosedImagesLog
from genre_tasks.logs.posed_images.posed_image import PosedImage
from genre_tasks.logs.posed_images.rig_poses import fill_rig_poses
from genre_tasks.logs.posed_images.world_axes import choose_reference, find_up, place_vehicle, turn_up_to_z
from genre_tasks.logs.registry import open_log
from genre_tasks.logs.types import Lens
from tests.logs.posed_images_folder import STREET, Y_DOWN, write_colmap, write_transforms

pytest.importorskip("embreex", reason="the synthetic street is ray-cast with Embree")

FORMATS: dict[str, Callable[[Path], str]] = {
    "transforms": lambda folder: f"posed_images:{write_transforms(folder, Y_DOWN)}?scale=2.5",
    "colmap text": lambda folder: f"posed_images:{write_colmap(folder, binary=False)}?scale=2.5",
    "colmap binary": lambda folder: f"posed_images:{write_colmap(folder, binary=True)}?scale=2.5",
}


@pytest.fixture(scope="module")
def written(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_transforms(tmp_path_factory.mktemp("street"))


def rewrite(folder: Path, written: Path, change: Callable[[dict[str, Any]], None]) -> str:
    """A transforms.json of the same images, changed."""
    values = json.loads((written / "transforms.json").read_text())
    change(values)
    (folder / "transforms.json").write_text(json.dumps(values))
    return f"posed_images:{folder}?images={written}"


@pytest.mark.parametrize("name", FORMATS)
def test_every_format_gives_the_street_in_metres_with_z_up(name: str, tmp_path: Path) -> None:
    log = open_log(FORMATS[name](tmp_path))
    street = open_log(STREET)
    assert [camera.name for camera in log.cameras] == sorted(camera.name for camera in street.cameras)
    assert log.frame_count == street.frame_count
    first = log.world_SE3_camera("front_camera", 0)
    true_first = street.world_SE3_camera("front_camera", 0)
    for frame in range(street.frame_count):
        for camera in street.cameras:
            pose = log.world_SE3_camera(camera.name, frame)
            # Turning to z up leaves the heading of the world free; distances and heights are the street's.
            true = street.world_SE3_camera(camera.name, frame)
            np.testing.assert_allclose(np.linalg.inv(first) @ pose, np.linalg.inv(true_first) @ true, atol=1e-6)
            assert pose[2, 3] == pytest.approx(true[2, 3], abs=1e-6)
        along = log.world_SE3_lidar(frame)[:3, 0] @ log.world_SE3_camera("front_camera", frame)[:3, 2]
        assert along > 0.9


def test_times_and_labels_of_the_file_make_the_frames(tmp_path: Path, written: Path) -> None:
    def label(values: dict[str, Any]) -> None:
        for n, frame in enumerate(values["frames"]):
            frame["camera"] = ("a", "b", "c")[n % 3]
            frame["time"] = 100.0 - n // 3

    log = open_log(rewrite(tmp_path, written, label))
    assert [camera.name for camera in log.cameras] == ["a", "b", "c"]
    assert [log.frame_timestamp_s(frame) for frame in range(3)] == [93.0, 94.0, 95.0]


def move_into_moments(folder: Path, written: Path, has_labels: bool) -> str:
    """The same images in a folder for each moment, such as ``000001/front_camera.png``."""

    def move(values: dict[str, Any]) -> None:
        for frame in values["frames"]:
            source = written / frame["file_path"]
            name = f"images/{int(source.stem):06d}/{source.parent.name}.png"
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(source, folder / name)
            frame.update(file_path=name, **{key: values["frames"][0][key] for key in ("fl_x", "fl_y", "cx", "cy")})
            if has_labels:
                frame["camera"] = source.parent.name.removesuffix("_camera")

    rewrite(folder, written, move)
    return f"posed_images:{folder}"


def test_labels_are_cameras_where_folders_are_moments(tmp_path: Path, written: Path) -> None:
    log = open_log(move_into_moments(tmp_path, written, has_labels=True))
    recorded = open_log(f"posed_images:{written}")
    assert [f"{camera.name}_camera" for camera in log.cameras] == [camera.name for camera in recorded.cameras]
    assert log.frame_count == recorded.frame_count == 8
    for frame in range(8):
        for camera in log.cameras:
            image = log.image_bytes(camera.name, frame)
            assert image is not None and image == recorded.image_bytes(f"{camera.name}_camera", frame)


def test_moments_without_labels_of_cameras_are_refused(tmp_path: Path, written: Path) -> None:
    with pytest.raises(InputError, match="8 numbered folders have images such as front_camera") as caught:
        open_log(move_into_moments(tmp_path, written, has_labels=False))
    assert "`camera`" in caught.value.remedy


@pytest.mark.parametrize("label", ["a camera's", "an image's", "one for all", "none"])
def test_numbered_folders_of_cameras_stay_cameras(label: str) -> None:
    def image(camera: int, frame: int) -> PosedImage:
        labels = {"a camera's": f"c{camera}", "an image's": f"{camera}-{frame}", "one for all": "1", "none": None}
        name = f"images/{camera}/{frame:04d}.png"
        return PosedImage(name, np.eye(4), Lens(60.0, 60.0, 32.0, 18.0, 64, 36), labels[label])

    found = group_frames([image(camera, frame) for camera in range(5) for frame in range(3)], Path("poses"))
    assert found.cameras == tuple("01234") and len(found.frames) == 3
    assert [frame["4"].name for frame in found.frames] == [f"images/4/000{frame}.png" for frame in range(3)]


def test_cameras_that_fire_one_after_the_other_share_frames(tmp_path: Path, written: Path) -> None:
    delays = {"a": 0.0, "b": 0.03, "c": -0.02}

    def label(values: dict[str, Any]) -> None:
        for n, frame in enumerate(values["frames"]):
            camera = "abc"[n % 3]
            frame.update(camera=camera, time=50.0 + 0.1 * (n // 3) + delays[camera])

    log = open_log(rewrite(tmp_path, written, label))
    assert log.frame_count == 8 and all(log.image_bytes(c, frame) for c in "abc" for frame in range(8))
    assert log.frame_timestamp_s(3) == pytest.approx(50.3)
    assert [log.camera_timestamp_s(camera, 3) for camera in "abc"] == pytest.approx([50.3, 50.33, 50.28])


def other_clock(values: dict[str, Any]) -> None:
    for n, frame in enumerate(values["frames"]):
        frame.update(camera="abc"[n % 3], time=0.1 * (n // 3) + (1000.0 if n % 3 == 2 else 0.0))


def test_a_missing_image_is_none_and_its_camera_stays_on_the_rig(tmp_path: Path, written: Path) -> None:
    def drop(values: dict[str, Any]) -> None:
        values["frames"] = [f for f in values["frames"] if "front_camera/0003" not in f["file_path"]]

    complete = open_log(f"posed_images:{written}")
    log = open_log(rewrite(tmp_path, written, drop))
    assert log.image_bytes("front_camera", 3) is None
    gap = log.world_SE3_camera("front_camera", 3)[:3, 3] - complete.world_SE3_camera("front_camera", 3)[:3, 3]
    assert np.linalg.norm(gap) < 0.05


def test_pairs_of_cameras_that_take_turns_share_one_path() -> None:
    def place(camera: str, frame: int) -> PosedImage:
        pose = np.eye(4)
        pose[:3, 3] = (1000.0 + frame, {"a": 0.0, "b": 0.0, "c": 0.5, "d": 0.5}[camera], 1.5)
        return PosedImage(f"{camera}/{frame}.png", pose, Lens(60.0, 60.0, 32.0, 18.0, 64, 36))

    frames = tuple({name: place(name, k) for name in ("ad" if k % 2 == 0 else "bc")} for k in range(12))
    poses = fill_rig_poses(FrameGroups(tuple("abcd"), frames, None), np.eye(3), 1.0)
    for name, across in zip("abcd", (0.0, 0.0, 0.5, 0.5), strict=True):
        np.testing.assert_allclose(poses.world_SE3_camera[name][:, 0, 3], 1000.0 + np.arange(12), atol=1e-9)
        np.testing.assert_allclose(poses.world_SE3_camera[name][:, 1, 3], across, atol=1e-9)


def test_half_size_images_scale_the_lens(tmp_path: Path, written: Path) -> None:
    for path in sorted((written / "images").rglob("*.png")):
        target = tmp_path / path.relative_to(written)
        target.parent.mkdir(parents=True, exist_ok=True)
        Image.open(path).resize((48, 27)).save(target)
    log = open_log(f"posed_images:{written}?images={tmp_path}")
    full = open_log(f"posed_images:{written}")
    assert log.cameras[0].lens == full.cameras[0].lens.resized(48, 27)
    assert log.digest() != full.digest()


def test_one_small_image_does_not_define_the_lens(tmp_path: Path, written: Path) -> None:
    shutil.copytree(written / "images", tmp_path / "images")
    path = tmp_path / "images/front_camera/0000.png"
    Image.open(path).resize((48, 27)).save(path)
    log = open_log(f"posed_images:{written}?images={tmp_path}")
    assert log.cameras == open_log(f"posed_images:{written}").cameras


def test_the_folder_of_one_camera_is_not_that_of_all(written: Path) -> None:
    with pytest.raises(InputError, match="two images of the poses are one file") as caught:
        open_log(f"posed_images:{written}?images={written}/images/front_camera")
    assert "--images" in caught.value.remedy and caught.value.file


def no_overlap(values: dict[str, Any]) -> None:
    for n, frame in enumerate(values["frames"]):
        frame["file_path"] = frame["file_path"].replace(".png", f"-{n}.png")


def other_lens(values: dict[str, Any]) -> None:
    values["frames"][3]["fl_x"] += 1.0


def mirrored(values: dict[str, Any]) -> None:
    values["frames"][0]["transform_matrix"][0] = [-x for x in values["frames"][0]["transform_matrix"][0]]


def not_there(values: dict[str, Any]) -> None:
    for frame in values["frames"]:
        frame["file_path"] += ".jpeg"


def timed_but_for_one(values: dict[str, Any]) -> None:
    for n, frame in enumerate(values["frames"]):
        frame.update(time=0.1 * n)
    del values["frames"][7]["time"]
    values["frames"][7]["file_path"] = "images/lacks-it.png"


def one_unset_time(values: dict[str, Any]) -> None:
    for n, frame in enumerate(values["frames"]):
        frame.update(camera="abc"[n % 3], time=1.6e15 + 1e5 * (n // 3) if n else 0)


def labelled_elsewhere(values: dict[str, Any]) -> None:
    for n, frame in enumerate(values["frames"]):
        frame.update(camera=("a", "b", "../../x")[n % 3], time=n // 3)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (no_overlap, "no partner of the same name"),
        (other_clock, "8 of 8 images of c have no partner near their time"),
        (other_lens, "more than one set of intrinsics"),
        (mirrored, "mirrored"),
        (timed_but_for_one, "1 of 24 images have no time, the first one is .*lacks-it.png"),
        (one_unset_time, "the times of the images span 1.6e"),
        (not_there, "none of the 24 images is there"),
        (lambda v: v.update(camera_model="OPENCV_FISHEYE"), "camera model OPENCV_FISHEYE is not supported"),
        (lambda v: v.update(k4=0.1), "k4"),
        (lambda v: v.update(frames=[]), "no list of frames"),
        (lambda v: v["frames"][0].update(fl_x=float("1e400")), "cannot be read"),
        (lambda v: v["frames"][0].update(cx="middle"), "lack a number for cx"),
        (lambda v: v["frames"][0].pop("transform_matrix"), "no transform_matrix"),
        (labelled_elsewhere, "cannot be a folder's name"),
    ],
)
def test_what_cannot_be_read_is_an_error_with_a_remedy(
    change: Callable[[dict[str, Any]], None], words: str, tmp_path: Path, written: Path
) -> None:
    with pytest.raises(InputError, match=words) as caught:
        open_log(rewrite(tmp_path, written, change))
    assert caught.value.remedy and caught.value.file


def test_no_name_leads_out_of_the_folder(tmp_path: Path, written: Path) -> None:
    (tmp_path / "secret.png").write_bytes(b"secret")
    inner = tmp_path / "inner"
    inner.mkdir()

    def escape(values: dict[str, Any]) -> None:
        values["frames"][0]["file_path"] = "../secret.png"
        values["frames"] = values["frames"][:1]

    with pytest.raises(InputError, match="none of the 1 images"):
        open_log(rewrite(inner, written, escape))


def test_a_fisheye_of_colmap_is_named(tmp_path: Path) -> None:
    folder = write_colmap(tmp_path, binary=False) / "sparse/0"
    text = (folder / "cameras.txt").read_text().replace("PINHOLE", "OPENCV_FISHEYE", 1)
    (folder / "cameras.txt").write_text(text)
    with pytest.raises(InputError, match="OPENCV_FISHEYE"):
        read_colmap_model(folder)


@pytest.mark.parametrize("length", [4, 60, 200])
def test_a_cut_off_model_is_an_error(length: int, tmp_path: Path) -> None:
    folder = write_colmap(tmp_path, binary=True) / "sparse/0"
    (folder / "images.bin").write_bytes((folder / "images.bin").read_bytes()[:length])
    with pytest.raises(InputError, match="cannot be read"):
        read_colmap_model(folder)


@pytest.mark.parametrize(
    ("model", "parameters", "distortion"),
    [
        ("SIMPLE_PINHOLE", "50 40 30", ()),
        ("SIMPLE_RADIAL", "50 40 30 0.1", (0.1, 0.0, 0.0, 0.0, 0.0)),
        ("RADIAL", "50 40 30 0.1 0.2", (0.1, 0.2, 0.0, 0.0, 0.0)),
        ("OPENCV", "50 50 40 30 0.1 0.2 0.3 0.4", (0.1, 0.2, 0.3, 0.4, 0.0)),
    ],
)
def test_lenses_of_colmap(model: str, parameters: str, distortion: tuple[float, ...], tmp_path: Path) -> None:
    (tmp_path / "cameras.txt").write_text(f"1 {model} 80 60 {parameters}\n")
    (tmp_path / "images.txt").write_text("1 1 0 0 0 1 2 3 1 a b.png\n\n")
    (image,) = read_colmap_model(tmp_path)
    assert image.name == "a b.png" and image.source_SE3_camera[:3, 3].tolist() == [-1.0, -2.0, -3.0]
    lens = image.lens
    assert (lens.fx_px, lens.fy_px, lens.cx_px, lens.cy_px, lens.distortion) == (50.0, 50.0, 40.0, 30.0, distortion)


@pytest.mark.parametrize("query", ["up=0,0", "up=0,0,0", "scale=-1", "scale=many", "size=3"])
def test_wrong_options_are_configuration_errors(query: str, written: Path) -> None:
    with pytest.raises(ConfigError):
        open_log(f"posed_images:{written}?{query}")


# --- axes


def pitched(count: int, degrees: float) -> np.ndarray:
    """Cameras that look along x and down by so many degrees, world z up."""
    angle = np.deg2rad(degrees)
    forward = np.array([np.cos(angle), 0.0, -np.sin(angle)])
    right = np.array([0.0, -1.0, 0.0])
    pose = np.eye(4)
    pose[:3, :3] = np.stack([right, np.cross(forward, right), forward], 1)
    return np.tile(pose, (count, 1, 1))


def test_cameras_that_look_down_do_not_tilt_the_world() -> None:
    path = np.zeros((10, 3))
    path[:, 0] = np.arange(10)
    tilted = find_up(pitched(10, 12.0), np.zeros((10, 3)), Path("poses"))
    assert tilted.vector @ [0.0, 0.0, 1.0] < 0.99
    assert find_up(pitched(10, 12.0), path, Path("poses")).vector.tolist() == [0.0, 0.0, 1.0]
    # A path with a turn is a plane.
    path[5:, 1] = np.arange(5)
    assert find_up(pitched(10, 12.0), path, Path("poses")).vector.tolist() == [0.0, 0.0, 1.0]


def test_cameras_in_all_directions_have_no_up() -> None:
    poses = np.stack([pitched(1, 0.0)[0], pitched(1, 0.0)[0] @ np.diag([-1.0, -1.0, 1.0, 1.0])])
    with pytest.raises(InputError, match="which way is up"):
        find_up(poses, np.zeros((2, 3)), Path("poses"))


@pytest.mark.parametrize("up", [(0.0, 0.0, -1.0), (0.0, 1.0, 0.0), (0.3, -0.8, 0.52), (1e-8, 0.0, -1.0)])
def test_up_becomes_z(up: tuple[float, float, float]) -> None:
    rotation = turn_up_to_z(np.array(up))
    np.testing.assert_allclose(rotation @ np.array(up) / np.linalg.norm(up), [0.0, 0.0, 1.0], atol=1e-6)
    np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-9)
    assert np.linalg.det(rotation) == pytest.approx(1.0)


def test_a_vehicle_that_stands_faces_where_its_cameras_look() -> None:
    poses = place_vehicle(np.zeros((3, 3)), np.array([0.0, 2.0, -1.0]))
    assert poses[0, :3, 0].tolist() == [0.0, 1.0, 0.0]
    assert poses[0, :3, 1].tolist() == [-1.0, 0.0, 0.0]


def test_noise_of_poses_chooses_no_camera_where_the_vehicle_stands() -> None:
    ahead, back = np.tile(np.eye(4), (2, 3, 1, 1))
    back[:, 2, 2] = -1.0
    along = np.array([0.0, 0.0, 1.0])
    assert [choose_reference([ahead, back], sign * 5.0 * along) for sign in (1, -1)] == [0, 1]
    assert choose_reference([ahead, back], -0.005 * along) == 0


def test_assumed_times_are_a_note(written: Path) -> None:
    log = open_log(f"posed_images:{written}")
    assert isinstance(log, PosedImagesLog)
    assert [finding.word for finding in log.findings()] == ["assumed_times"]


@pytest.mark.parametrize("address", ["~nobody-of-this-name/x", "{}?images=~nobody-of-this-name/x"])
def test_a_home_folder_of_nobody_is_an_error(address: str, written: Path) -> None:
    with pytest.raises(InputError, match="no home folder of this user"):
        open_log(f"posed_images:{address.format(written)}")
