"""From a scene, camera poses and images to the log and the settings of a run."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from genre_tasks.config import IngestConfig, PipelineConfig
from genre_tasks.errors import ConfigError, InputError
from genre_tasks.logs.log_selection import choose_working_size

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from genre_tasks.logs.posed_images.image_log import PosedImagesLog

AUTO = "auto"
ASSUMED_HEIGHT_M = 1.6
"""Height of a camera over the road that ``--scale auto`` assumes: between that of a car's mirror and of a van's."""

_FORMATS_WITH_AXES = frozenset({"spz", "glb", "usdz"})
_SHORT_CHUNK_SOURCE_EVERY = 2
# Moved poses would not be those that the scene was fitted to, and points of its own depth cannot tell that recorded
# ones err. Blur and view-dependent colours are those of the file, whatever the images call for.
_UNCHANGED_EFFECTS = ("effects.pose_refinement=off", "effects.anti_aliasing=off", "effects.view_dependent_colour=off")


@dataclass(frozen=True)
class EnhancementInputs:
    """What the user gives.

    Attributes:
        scene: file of Gaussians.
        cameras: transforms.json, or the folder of a COLMAP model.
        images: folder of images; ``None``: near the cameras.
        lidar: PLY of points in the coordinates of the poses; ``None``: there is no LiDAR.
        up: ``auto``, or a direction in the axes of the poses.
        scale: ``auto``, or metres a unit of the poses; ``None``: 1 with LiDAR, else it has to be said.
        chunk_frames: frames of a chunk; ``None``: the preset's.
    """

    scene: Path
    cameras: Path
    images: Path | None = None
    lidar: Path | None = None
    up: str = AUTO
    scale: str | None = None
    chunk_frames: int | None = None

    def to_values(self) -> dict[str, Any]:
        """Gives plain values, such as a flow's parameters have to be."""
        return {name: str(value) if isinstance(value, Path) else value for name, value in asdict(self).items()}

    @classmethod
    def from_values(cls, values: Mapping[str, Any]) -> EnhancementInputs:
        """Makes inputs of what :meth:`to_values` gave.

        >>> inputs = EnhancementInputs(Path("scene.ply"), Path("transforms.json"), scale="1")
        >>> EnhancementInputs.from_values(inputs.to_values()) == inputs
        True
        """
        files = {name: Path(values[name]) for name in ("scene", "cameras", "images", "lidar") if values.get(name)}
        return cls(**{**values, **files})

    def list_options(self) -> list[str]:
        """Lists the options of a command line that stand for these inputs.

        >>> EnhancementInputs(Path("scene.ply"), Path("transforms.json"), chunk_frames=20).list_options()
        ['--scene', 'scene.ply', '--cameras', 'transforms.json', '--chunk-frames', '20']
        """
        words: list[str] = []
        for name, value in self.to_values().items():
            # What is as by default says nothing.
            if value is not None and (name, value) != ("up", AUTO):
                words += [f"--{name.replace('_', '-')}", str(value)]
        return words


@dataclass(frozen=True)
class EnhancementRequest:
    """The run that enhances a scene.

    Attributes:
        log: URI of the images with poses.
        settings: ``section.key=value`` strings, to be followed by the user's.
        explanation: a line for each thing that was found or assumed.
    """

    log: str
    settings: tuple[str, ...]
    explanation: tuple[str, ...]


def prepare_enhancement(inputs: EnhancementInputs, config: PipelineConfig) -> EnhancementRequest:
    """Finds out which way is up and how long a metre is, and asks for a run that starts from the scene.

    Args:
        inputs: what the user gives.
        config: the preset's.

    Returns:
        The run.

    Raises:
        InputError: a file is missing or unsound, or nothing tells the scale.
        ConfigError: up or scale is none.
    """
    from genre_tasks.logs.posed_images.poses_address import format_uri, parse_direction, parse_scale
    from genre_tasks.logs.registry import open_log

    for file in (inputs.scene, inputs.lidar):
        if file is not None and not file.is_file():
            raise InputError("there is no such file", remedy="Correct the path.", file=file)
    _require_axes_of_poses(inputs.scene)
    if inputs.scale is None and inputs.lidar is None:
        raise ConfigError(
            "nothing tells how long a metre is in this scene",
            remedy="Give --scale METRES_A_UNIT (1 if the poses are in metres), or --scale auto to assume that cameras "
            f"are {ASSUMED_HEIGHT_M:g} m above the road.",
        )
    up = None if inputs.up == AUTO else parse_direction(inputs.up)
    log: PosedImagesLog = open_log(format_uri(inputs.cameras, inputs.images, up, None))  # type: ignore[assignment]
    explanation = [
        f"{log.frame_count} frames of {len(log.cameras)} cameras: {', '.join(camera.name for camera in log.cameras)}",
        f"up is {_format_vector(log.up.vector)}: {log.up.reason}",
    ]
    if inputs.scale == AUTO:
        scale = _measure_scale(log, inputs)
        explanation.append(f"a unit is {scale:.4g} m: the cameras are taken to be {ASSUMED_HEIGHT_M:g} m above ground")
    elif inputs.scale is None:
        scale = 1.0
        explanation.append("a unit is 1 m: the LiDAR's points are taken to be in metres")
    else:
        scale = parse_scale(inputs.scale)
        explanation.append(f"a unit is {scale:g} m, as asked for")
    depth = "the LiDAR's" if inputs.lidar else "the scene's own, where views agree: there is no LiDAR"
    explanation.append(f"depth is {depth}")
    explanation.append("the scene was fitted to these poses, which are refined only with effects.pose_refinement=on")
    # Written with the numbers that were found, so that the log stays the same when finding changes.
    uri = format_uri(inputs.cameras, inputs.images, log.up.vector, scale)
    # Opened again, because its numbers are those of the URI: scene and images must be placed by the same ones.
    placed: PosedImagesLog = open_log(uri)  # type: ignore[assignment]
    settings = _make_settings(inputs, placed, config.ingest)
    count = _count_gaussians(inputs.scene)
    expected = config.initial.max_points + config.initial.distant_count
    if count > expected and config.enet.split_fraction > 0:
        settings.append("enet.split_fraction=0")
        explanation.append(
            f"ENet splits none of the {count} Gaussians: the preset is made for {expected} before a split"
        )
    return EnhancementRequest(uri, tuple(settings), tuple(explanation))


def _require_axes_of_poses(scene: Path) -> None:
    """Refuses formats that state axes or units: readers turn and scale their Gaussians, and nothing turns the poses."""
    from genre_tasks.exchange.registry import find_format

    name = find_format(scene).name
    if name in _FORMATS_WITH_AXES:
        raise InputError(
            f"a {name} file has axes of its own, in which the poses of the cameras need not be",
            remedy="Give the scene as .ply or .splat in the axes and units of the poses. Convert it with a tool that "
            "leaves axes and units as they are; `genre import` and `genre export` turn them.",
            file=scene,
        )


def _count_gaussians(scene: Path) -> int:
    from genre_tasks.exchange.registry import find_format

    return sum(len(node.cloud) for node in find_format(scene).read(scene).nodes)


def _make_settings(inputs: EnhancementInputs, log: PosedImagesLog, ingest: IngestConfig) -> list[str]:
    chunk_frames = ingest.chunk_frames if inputs.chunk_frames is None else inputs.chunk_frames
    placement = f"{{scale: {log.metres_per_unit!r}, quat: {_find_quat(log.world_R_source)}}}"
    # The run's record has these, and is read from other folders.
    scene = inputs.scene.absolute()
    points = f"ingest.points={inputs.lidar.absolute()}" if inputs.lidar else f"ingest.scene={scene}"
    width, height = choose_working_size(ingest, log.cameras[:1])
    frames = min(chunk_frames, log.frame_count)
    settings = [
        f"ingest.chunk_frames={chunk_frames}",
        points,
        f"ingest.placement={placement}",
        f"ingest.width_px={width}",
        f"ingest.height_px={height}",
        f"initial.scene={scene}",
        f"initial.placement={placement}",
        # The scene is another program's work, and starts ENet as it is.
        "gnet.method=none",
        *_UNCHANGED_EFFECTS,
    ]
    # A handful of images would have one source frame, and nothing between two of them to compare with.
    if frames <= 2 * ingest.source_every:
        settings.append(f"ingest.source_every={_SHORT_CHUNK_SOURCE_EVERY if frames > 2 else 1}")
    return settings


def _find_quat(rotation: NDArray[np.float64]) -> list[float]:
    """w, x, y, z; exact where the rotation is the identity."""
    from scipy.spatial.transform import Rotation

    x, y, z, w = Rotation.from_matrix(rotation).as_quat().tolist()
    return [w + 0.0, x + 0.0, y + 0.0, z + 0.0]


def _measure_scale(log: PosedImagesLog, inputs: EnhancementInputs) -> float:
    from flows.enhancement.camera_height import measure_height_over_points, measure_height_over_scene

    if inputs.lidar is not None:
        height = measure_height_over_points(log, inputs.lidar)
    else:
        height = measure_height_over_scene(log, inputs.scene)
    return ASSUMED_HEIGHT_M / height


def _format_vector(vector: Sequence[float] | NDArray[np.float64]) -> str:
    return ", ".join(f"{value + 0.0:.3g}" for value in vector)
