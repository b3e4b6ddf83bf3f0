"""Options for a scene that another program made, its cameras and its images; several commands share them."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from flows.cli.parsing import parse_path

if TYPE_CHECKING:
    from flows.enhancement.enhancement_request import EnhancementInputs

SceneFileArgument = Annotated[
    Path, typer.Argument(parser=parse_path, metavar="SCENE", help="The file of Gaussians, such as a 3DGS PLY.")
]
_CAMERAS = typer.Option(
    parser=parse_path,
    metavar="PATH",
    help="Camera poses in the scene's coordinates: a transforms.json of nerfstudio or instant-ngp, or the folder "
    "of a COLMAP model.",
)
CamerasOption = Annotated[Path, _CAMERAS]
SceneCamerasOption = Annotated[Path | None, _CAMERAS]
SceneOption = Annotated[
    Path | None,
    typer.Option(
        "--scene",
        parser=parse_path,
        metavar="PATH",
        help="A file of Gaussians that any program made, such as a 3DGS PLY, in the place of logs. Table 2 then "
        "compares the scene before and after enhancement; it needs --cameras.",
    ),
]
ImagesOption = Annotated[
    Path | None,
    typer.Option(parser=parse_path, metavar="PATH", help="The folder of the images. Near the poses if not given."),
]
LidarOption = Annotated[
    Path | None,
    typer.Option(
        parser=parse_path,
        metavar="PATH",
        help="A PLY file with LiDAR points in the scene's coordinates. The scene's own depth if not given.",
    ),
]
UpOption = Annotated[
    str, typer.Option(help="Which way is up in the scene's axes, such as 0,0,1; auto finds it from the cameras.")
]
ScaleOption = Annotated[
    str | None,
    typer.Option(
        help="Metres a unit of the scene, such as 1; auto assumes that the cameras are 1.6 m above the ground. Must be "
        "given where there is no LiDAR."
    ),
]
ChunkFramesOption = Annotated[
    int | None, typer.Option(help="Frames of a chunk, each of which is enhanced by itself. The preset's if not given.")
]


def make_scene_inputs(
    scene: Path | None,
    cameras: Path | None,
    images: Path | None,
    lidar: Path | None,
    *,
    up: str,
    scale: str | None,
    chunk_frames: int | None,
) -> EnhancementInputs | None:
    """Puts the options of a scene together, for a command that also works without one.

    Args:
        scene: file of Gaussians; ``None``: there is no scene, and none of the others may be there.
        cameras: transforms.json, or the folder of a COLMAP model; a scene needs it.
        images: folder of images.
        lidar: PLY of points.
        up: ``auto``, or a direction.
        scale: ``auto``, or metres a unit.
        chunk_frames: frames of a chunk.

    Returns:
        The inputs; ``None`` without a scene.

    Raises:
        ConfigError: there is a scene and no cameras, or an option of a scene and no scene.
    """
    from flows.enhancement.enhancement_request import EnhancementInputs
    from genre_tasks.errors import ConfigError

    if scene is None:
        options = list_scene_options(cameras, images, lidar, up=up, scale=scale, chunk_frames=chunk_frames)
        for name, value in options.items():
            # Ignored, it would leave the user believing that it was used.
            if value is not None:
                raise ConfigError(f"{name} belongs to a scene, and there is none", remedy="Give --scene FILE too.")
        return None
    if cameras is None:
        raise ConfigError(
            f"nothing tells where the cameras of {scene} are",
            remedy="Give --cameras transforms.json, or --cameras with the folder of a COLMAP model.",
        )
    return EnhancementInputs(scene, cameras, images, lidar, up, scale, chunk_frames)


def list_scene_options(
    cameras: Path | None,
    images: Path | None,
    lidar: Path | None,
    *,
    up: str,
    scale: str | None,
    chunk_frames: int | None,
) -> dict[str, Path | str | int | None]:
    """Lists the options that belong to a scene.

    Args:
        cameras: transforms.json, or the folder of a COLMAP model.
        images: folder of images.
        lidar: PLY of points.
        up: ``auto``, or a direction.
        scale: ``auto``, or metres a unit.
        chunk_frames: frames of a chunk.

    Returns:
        Their values by name; ``None`` where one is not given, or is the default.
    """
    from flows.enhancement.enhancement_request import AUTO

    return {
        "--cameras": cameras,
        "--images": images,
        "--lidar": lidar,
        "--up": None if up == AUTO else up,
        "--scale": scale,
        "--chunk-frames": chunk_frames,
    }
