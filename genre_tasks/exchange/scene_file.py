"""Scenes from files and exported folders of any known format."""

from __future__ import annotations

from pathlib import Path

from genre_tasks.errors import InputError
from genre_tasks.exchange.registry import find_format
from genre_tasks.exchange.scene_folder import SCENE_FILE, read_scene_folder
from genre_tasks.exchange.types import ExchangeScene


def read_scene_file(path: Path) -> ExchangeScene:
    """Reads one scene, whatever its format is.

    Args:
        path: a file of a known format, or a folder that ``genre export`` wrote with one chunk.

    Returns:
        The scene.

    Raises:
        InputError: there is no such file, it is damaged, or the folder has several chunks.
        ConfigError: the format's package is not installed.
    """
    scenes = read_scene_files(path)
    if len(scenes) > 1:
        raise InputError(
            f"the folder has {len(scenes)} chunks",
            remedy=f"One at a time: export it again with --chunks {min(scenes)}, or give a file.",
            file=path,
        )
    return next(iter(scenes.values()))


def read_scene_files(path: Path) -> dict[int, ExchangeScene]:
    """Reads all scenes of a file or of an exported folder.

    Args:
        path: a file of a known format, or a folder that ``genre export`` wrote.

    Returns:
        Scene by chunk number; a file's scene has number 0.

    Raises:
        InputError: there is no such file, or it is damaged.
        ConfigError: the format's package is not installed.
    """
    if path.is_dir():
        return read_scene_folder(path)
    if path.name == SCENE_FILE:
        return read_scene_folder(path.parent)
    if not path.is_file():
        raise InputError("there is no such file or folder", remedy="Check the path.", file=path)
    return {0: find_format(path).read(path)}
