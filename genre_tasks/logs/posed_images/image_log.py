"""Images with poses as a driving log: no LiDAR, no annotations, a world in metres with z up."""

from __future__ import annotations

import hashlib
import re
from functools import cached_property
from pathlib import Path

import numpy as np

from genre_tasks.errors import InputError
from genre_tasks.logs.file_digest import digest_files
from genre_tasks.logs.findings import Finding
from genre_tasks.logs.log_address import split_log_address
from genre_tasks.logs.posed_images.colmap_model import read_colmap_model
from genre_tasks.logs.posed_images.frame_grouping import FrameGroups, group_frames
from genre_tasks.logs.posed_images.image_files import ImageFolder, fit_lens
from genre_tasks.logs.posed_images.poses_address import find_poses, parse_direction, parse_scale
from genre_tasks.logs.posed_images.rig_poses import RigPoses, fill_rig_poses
from genre_tasks.logs.posed_images.transforms_json import read_transforms
from genre_tasks.logs.posed_images.world_axes import UpDirection, find_up, turn_up_to_z
from genre_tasks.logs.types import Camera, CuboidTrack, Float64, Sweep, Truth
from genre_tasks.user_paths import expand_user_path

_OPTIONS = ("images", "up", "scale")
# What a file without times is taken for; frames must neither stand on one moment nor be minutes apart.
_ASSUMED_SPEED_M_S = 10.0
_PERIOD_RANGE_S = (0.05, 1.0)
# Names of folders that say nothing of what is in them.
_GENERIC_FOLDERS = ("0", "sparse", "colmap", "")


def open_posed_images(rest: str) -> PosedImagesLog:
    """Opens images with poses.

    Args:
        rest: ``PATH?images=DIR&up=X,Y,Z&scale=N``: PATH is a transforms.json, a folder that holds one, or one of a
            COLMAP model. ``up`` is a direction in the axes of the poses (found if not given), ``scale`` metres a unit
            (1 if not given). Special characters of paths are written with %, as in URLs.

    Returns:
        The log.

    Raises:
        InputError: poses or images are missing or unsound.
        ConfigError: an option is unknown or no such number.
    """
    path, options = split_log_address(rest, _OPTIONS, "images with poses")
    return PosedImagesLog(
        uri=f"posed_images:{rest}",
        poses=find_poses(expand_user_path(path)),
        images=expand_user_path(options["images"]) if options.get("images") else None,
        up=parse_direction(options["up"]) if options.get("up") else None,
        scale=parse_scale(options.get("scale", "1")),
    )


class PosedImagesLog:
    """Images with poses as a driving log; see ``DrivingLog``.

    Args:
        uri: what the user wrote.
        poses: from :func:`find_poses`.
        images: folder of the images; ``None``: near the poses.
        up: [3] direction in the axes of the poses; ``None``: found.
        scale: metres a unit.
    """

    dataset = "posed_images"

    def __init__(self, uri: str, poses: Path, images: Path | None, up: Float64 | None, scale: float) -> None:
        self.uri = uri
        self.metres_per_unit = scale
        self._poses = poses
        is_colmap = poses.is_dir()
        read = read_colmap_model(poses) if is_colmap else read_transforms(poses)
        self._groups: FrameGroups = group_frames(read, poses)
        self._images = images if images is not None else _find_images(poses)
        if not self._images.is_dir():
            raise InputError("there is no folder of images", remedy="Name it with --images.", file=self._images)
        folder = ImageFolder(self._images)
        self._files = [{camera: folder.find(i.name) for camera, i in f.items()} for f in self._groups.frames]
        if not any(path for frame in self._files for path in frame.values()):
            first = read[0].name
            problem = f"none of the {len(read)} images is there; the first is {first}"
            raise InputError(problem, remedy="Name their folder with --images.", file=self._images)
        matrices = np.stack([image.source_SE3_camera for image in read])
        self.up = self._choose_up(up, matrices)
        # Scaled and turned about the origin of the poses, which stays the world's.
        self.world_R_source = turn_up_to_z(self.up.vector)
        self._rig: RigPoses = fill_rig_poses(self._groups, self.world_R_source, scale)

    def _choose_up(self, up: Float64 | None, matrices: Float64) -> UpDirection:
        if up is not None:
            return UpDirection(up, "as asked for")
        frames = self._groups.frames
        centers = np.stack([np.mean([i.source_SE3_camera[:3, 3] for i in f.values()], axis=0) for f in frames])
        return find_up(matrices, centers, self._poses)

    @property
    def name(self) -> str:
        """The name of the folder that the poses are in."""
        folder = self._poses.resolve() if self._poses.is_dir() else self._poses.resolve().parent
        while folder.name in _GENERIC_FOLDERS and folder != folder.parent:
            folder = folder.parent
        return re.sub(r"[^\w.=,+-]", "_", folder.name, flags=re.ASCII) or "images"

    @property
    def frame_count(self) -> int:
        """How many moments there are."""
        return len(self._groups.frames)

    @cached_property
    def cameras(self) -> tuple[Camera, ...]:
        """The cameras, with lenses at the size of the images; a camera without any image is left out."""
        cameras = []
        for name in self._groups.cameras:
            files = [path for frame in self._files if (path := frame.get(name)) is not None]
            if files:
                lens = next(frame[name].lens for frame in self._groups.frames if name in frame)
                cameras.append(Camera(name, fit_lens(lens, name, files)))
        return tuple(cameras)

    @cached_property
    def _times(self) -> Float64:
        """[F] seconds."""
        if self._groups.times_s is not None:
            return np.array(self._groups.times_s)
        path = self._rig.world_SE3_ego[:, :3, 3]
        steps = np.linalg.norm(np.diff(path, axis=0), axis=1)
        step = float(np.median(steps)) if len(steps) else 0.0
        period_s = float(np.clip(step / _ASSUMED_SPEED_M_S, *_PERIOD_RANGE_S))
        times: Float64 = period_s * np.arange(self.frame_count, dtype=np.float64)
        return times

    def frame_timestamp_s(self, frame: int) -> float:
        """The time of a frame; assumed where the file has no times."""
        return float(self._times[self._check_frame(frame)])

    def world_SE3_lidar(self, frame: int) -> Float64:
        """The pose [4, 4] of the vehicle: at the camera that looks ahead, x along the motion, z up."""
        pose: Float64 = self._rig.world_SE3_ego[self._check_frame(frame)].copy()
        return pose

    def world_SE3_camera(self, camera: str, frame: int) -> Float64:
        """The pose [4, 4] of a camera; where it has no image, its place on the rig."""
        self._check_frame(frame)
        pose: Float64 = self._rig.world_SE3_camera[self._check_camera(camera)][frame].copy()
        return pose

    def camera_timestamp_s(self, camera: str, frame: int) -> float:
        """The time of a camera's image; that of the frame where it has none."""
        self._check_camera(camera)
        image = self._groups.frames[self._check_frame(frame)].get(camera)
        return self.frame_timestamp_s(frame) if image is None or image.time_s is None else float(image.time_s)

    def image_bytes(self, camera: str, frame: int) -> bytes | None:
        """The encoded image, ``None`` where there is none."""
        self._check_camera(camera)
        path = self._files[self._check_frame(frame)].get(camera)
        if path is None:
            return None
        try:
            return path.read_bytes()
        except OSError as error:
            raise InputError(
                f"the image cannot be read: {error.strerror}",
                remedy="Copy it again.",
                file=path,
                log=self.name,
                camera=camera,
                frame=frame,
            ) from error

    def sweep(self, frame: int) -> Sweep | None:
        """Nothing: there is no LiDAR."""
        self._check_frame(frame)
        return None

    def tracks(self) -> tuple[CuboidTrack, ...]:
        """Nothing: there are no annotations."""
        return ()

    @property
    def truth(self) -> Truth | None:
        """Nothing: the images are recorded."""
        return None

    def findings(self) -> tuple[Finding, ...]:
        """What was assumed, for ``genre check``."""
        if self._groups.times_s is not None:
            return ()
        message = (
            f"the poses have no times; {_ASSUMED_SPEED_M_S:.0f} m/s is assumed, as far as that gives steady frames"
        )
        return (Finding("assumed_times", "note", message, "Write `time` into every frame of transforms.json."),)

    @cached_property
    def _digest(self) -> str:
        is_folder = self._poses.is_dir()
        poses = [p for p in self._poses.iterdir() if p.suffix in (".bin", ".txt")] if is_folder else [self._poses]
        found = [path for frame in self._files for path in frame.values() if path is not None]
        # Numbers that the images' place in the world depends on; the up direction counts as it was found.
        place = (*self.up.vector.tolist(), self.metres_per_unit)
        parts = (
            digest_files(poses[0].parent, poses, ()),
            digest_files(self._images, found, ()),
            ",".join(map(repr, place)),
        )
        return hashlib.sha256("\n".join(parts).encode()).hexdigest()

    def digest(self) -> str:
        """Identifies poses, images, up and scale."""
        return self._digest

    def _check_frame(self, frame: int) -> int:
        if not 0 <= frame < self.frame_count:
            remedy = f"Choose from 0 to {self.frame_count - 1}."
            raise InputError(f"there is no frame {frame}", remedy=remedy, log=self.name, frame=frame)
        return frame

    def _check_camera(self, camera: str) -> str:
        if camera not in self._rig.world_SE3_camera:
            known = ", ".join(self._groups.cameras)
            raise InputError("unknown camera", remedy=f"Choose from {known}.", log=self.name, camera=camera)
        return camera


def _find_images(poses: Path) -> Path:
    """The folder that names of images most likely start from."""
    if poses.is_file():
        return poses.parent
    # COLMAP's models lie in PROJECT/sparse/0, its images in PROJECT/images.
    for folder in (poses, *poses.resolve().parents[:3]):
        if (folder / "images").is_dir():
            return folder / "images"
    return poses
