"""Addresses of scenes: ``nuscenes:ROOT/scene-0061?version=v1.0-mini&rate=10``."""

from __future__ import annotations

import fnmatch
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from urllib.parse import quote

from genre_tasks.errors import ConfigError, InputError
from genre_tasks.logs.log_address import split_log_address
from genre_tasks.logs.nuscenes.scene_index import read_scene_index
from genre_tasks.logs.nuscenes.scene_rows import list_scene_names
from genre_tasks.user_paths import expand_user_path

RATES_HZ = (2, 10, 20)

_OPTIONS = ("version", "rate")
_SCENES_FILE = "scene.json"
_REMEDY = "Give the folder that holds the tables' folder and a scene, as in nuscenes:PATH/scene-0061."


@dataclass(frozen=True)
class SceneAddress:
    """Where a scene is.

    Attributes:
        root: folder that holds ``samples`` and ``sweeps``.
        tables: folder of a version's tables.
        scene: name, or a pattern of names.
        rate_hz: 2, 10 or 20.
        query: options as the user wrote them, with the question mark; empty without.
    """

    root: Path
    tables: Path
    scene: str
    rate_hz: int
    query: str


def parse_scene_address(rest: str) -> SceneAddress:
    """Parses what follows ``nuscenes:``.

    Args:
        rest: ``ROOT/SCENE``, or ``ROOT/VERSION/SCENE``; with options ``version`` and ``rate``.

    Returns:
        The address; whether there is such a scene is not known yet.

    Raises:
        InputError: there are no tables, or those of several versions.
        ConfigError: an option is unknown, or the rate is none of those that there are.
    """
    uri = f"nuscenes:{rest}"
    text, options = split_log_address(rest, _OPTIONS, "nuScenes")
    rate = options.get("rate", "10")
    if rate not in map(str, RATES_HZ):
        raise ConfigError(f"the rate is {rate!r}", remedy=f"Choose from {', '.join(map(str, RATES_HZ))}.", log=uri)
    path = expand_user_path(text)
    root = path.parent
    if not text or not path.name or not root.is_dir():
        raise InputError("there is no such folder", remedy=_REMEDY, file=root, log=uri)
    query = rest.partition("?")[2]
    # Mini and full tables may lie beside one another.
    versions = _list_versions(root)
    # A user may name the version's folder instead of the one above it.
    if not versions and (root / _SCENES_FILE).is_file():
        tables = root
        root = root.parent
    else:
        tables = root / _choose_version(options.get("version"), versions, path, uri)
    return SceneAddress(root, tables, path.name, int(rate), f"?{query}" if query else "")


def _list_versions(root: Path) -> list[str]:
    return sorted(path.parent.name for path in root.glob(f"v*/{_SCENES_FILE}"))


def _choose_version(wanted: str | None, versions: list[str], path: Path, uri: str) -> str:
    if not versions:
        where: dict[str, Any] = {"file": path.parent, "log": uri}
        # Somebody may forget the scene.
        if path.is_dir() and _list_versions(path):
            where["file"] = path
            raise InputError("no scene is named", remedy=f"{_REMEDY} A star stands for all: nuscenes:PATH/*.", **where)
        problem = f"no tables of nuScenes here: no folder such as v1.0-mini with {_SCENES_FILE}"
        raise InputError(problem, remedy=_REMEDY, **where)
    if wanted is None and len(versions) == 1:
        return versions[0]
    if wanted in versions:
        return str(wanted)
    problem = "there are several versions" if wanted is None else f"there is no version {wanted!r}"
    remedy = f"Choose one with ?version=, from {', '.join(versions)}."
    raise InputError(problem, remedy=remedy, file=path.parent, log=uri)


def list_scenes(rest: str) -> list[str]:
    """Lists the scenes that a pattern stands for.

    Args:
        rest: what follows ``nuscenes:``, with stars in the scene's name.

    Returns:
        What follows ``nuscenes:`` for each of them, sorted by name, with the same options.

    Raises:
        InputError: there are no tables, or they cannot be read.
    """
    address = parse_scene_address(rest)
    names = read_scene_index(address.tables, f"nuscenes:{rest}", list_scene_names)
    # Only a star stands for other characters, as in names of folders.
    pattern = address.scene.replace("[", "[[]").replace("?", "[?]")
    folder = expand_user_path(split_log_address(rest, _OPTIONS, "nuScenes")[0]).parent
    found = [folder / name for name in names if fnmatch.fnmatchcase(name, pattern)]
    return [quote(str(path), safe="/ ") + address.query for path in found]
