"""Readers of driving logs by name: ``open_log("pandaset:PATH/002")``.

A reader is a function ``open(rest: str) -> DrivingLog``, given as ``"module:function"`` and imported when first used.
"""

from __future__ import annotations

import importlib
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from genre_tasks.errors import InputError
from genre_tasks.logs.types import DrivingLog
from genre_tasks.suggestions import did_you_mean
from genre_tasks.user_paths import expand_user_path


@dataclass(frozen=True)
class ReaderEntry:
    """Where to find a reader.

    Attributes:
        target: ``"module:function"``.
        example: a URI that the reader opens, for error messages. ``PATH`` behind the colon says that a path stands
            there, which is made absolute for other machines' workers.
        install_hint: what to install if importing the module fails.
        lister: ``"module:function"`` that lists the logs of a pattern, where logs are no folders; empty: they are.
        path_options: options behind the question mark whose values are paths, too.
        is_quoted: whether special characters of a path are written with %, as ``split_log_address`` reads them.
    """

    target: str
    example: str
    install_hint: str
    lister: str = ""
    path_options: tuple[str, ...] = ()
    is_quoted: bool = False


# Targets are text, not functions: importing every reader would need the packages of all, and would slow down each
# command.
_READERS: dict[str, ReaderEntry] = {
    "argoverse2": ReaderEntry(
        "genre_tasks.logs.argoverse2.reader:open_argoverse2",
        "argoverse2:PATH/7fab2350-7eaf-3b7e-a39d-6937a4c1bede",
        "pip install genre (pyarrow is part of it)",
    ),
    "genre": ReaderEntry(
        "genre_tasks.logs.genre_layout.reader:open_genre_layout",
        "genre:PATH/my-log",
        "pip install genre (pyarrow is part of it)",
    ),
    "kitti": ReaderEntry(
        "genre_tasks.logs.kitti.reader:open_kitti",
        "kitti:PATH/2011_09_26/2011_09_26_drive_0009_sync",
        "pip install genre (scipy and pillow are part of it)",
        path_options=("labels",),
        is_quoted=True,
    ),
    "nuscenes": ReaderEntry(
        "genre_tasks.logs.nuscenes.reader:open_nuscenes",
        "nuscenes:PATH/scene-0061",
        "pip install genre (scipy and pillow are part of it)",
        "genre_tasks.logs.nuscenes.scene_address:list_scenes",
        is_quoted=True,
    ),
    "pandaset": ReaderEntry(
        "genre_tasks.logs.pandaset.reader:open_pandaset",
        "pandaset:PATH/002",
        "pip install genre (pillow is part of it)",
    ),
    "posed_images": ReaderEntry(
        "genre_tasks.logs.posed_images.image_log:open_posed_images",
        "posed_images:PATH/transforms.json?images=DIR",
        "pip install genre (scipy and pillow are part of it)",
        path_options=("images",),
        is_quoted=True,
    ),
    "synthetic": ReaderEntry(
        "genre_tasks.logs.synthetic:open_synthetic",
        "synthetic:street?seed=1000",
        "pip install trimesh embreex (the street is ray-cast with Embree)",
    ),
    "waymo": ReaderEntry(
        "genre_tasks.logs.waymo.reader:open_waymo",
        "waymo:PATH/10023947602400723454_1120_000_1140_000",
        "pip install genre (pyarrow is part of it)",
        "genre_tasks.logs.waymo.segment_address:list_segments",
    ),
}


def register(name: str, target: str, install_hint: str, example: str = "") -> None:
    """Adds a reader, so that ``open_log`` opens URIs that begin with its name.

    Args:
        name: what stands before the colon of a URI.
        target: ``"module:function"``; the function takes what stands behind the colon and returns a ``DrivingLog``.
        install_hint: what to install if importing the module fails.
        example: a URI for error messages; by default ``name:…``.

    Raises:
        ValueError: another reader has that name.

    Example::

        register("rosbag", "my_package.bags:open_bag", "pip install my_package", "rosbag:PATH/drive.bag")
        log = open_log("rosbag:/data/drive.bag")
    """
    # The same target again is no error: a module that registers its reader may be imported twice.
    if name in _READERS and _READERS[name].target != target:
        raise ValueError(f"the reader {name!r} exists already, at {_READERS[name].target}")
    _READERS[name] = ReaderEntry(target, example or f"{name}:…", install_hint)


def known_readers() -> tuple[str, ...]:
    """Lists the names that ``open_log`` understands.

    Returns:
        The names, sorted.

    >>> known_readers()
    ('argoverse2', 'genre', 'kitti', 'nuscenes', 'pandaset', 'posed_images', 'synthetic', 'waymo')
    """
    return tuple(sorted(_READERS))


def open_log(uri: str) -> DrivingLog:
    """Opens a driving log by its URI; cheap, since nothing but small files is read.

    Args:
        uri: ``reader:rest``, such as ``pandaset:PATH/002`` or ``synthetic:street?seed=1000``.

    Returns:
        The log.

    Raises:
        InputError: no reader of that name, a reader whose packages are not installed, or no such log.
        ConfigError: a parameter of a synthetic log is unknown or out of range.

    >>> open_log("synthetic:street?seed=1000").frame_count
    20
    """
    name, colon, rest = uri.partition(":")
    entry = _READERS.get(name)
    examples = f"Known: {', '.join(_READERS[reader].example for reader in known_readers())}."
    if entry is None:
        # A path alone is the most frequent slip; it may hold a colon itself.
        is_folder = uri != "" and expand_user_path(uri).is_dir()
        hint = f"Did you mean 'pandaset:{uri}'? " if is_folder else did_you_mean(name, _READERS)
        problem = f"unknown reader {name!r}" if colon else f"a log is given as reader:where, {uri!r} names no reader"
        raise InputError(problem, remedy=hint + examples, log=uri)
    log: DrivingLog = _import_function(entry, entry.target, uri)(rest)
    return log


def make_log_absolute(uri: str) -> str:
    """Writes a log's URI so that it names the same log from every working folder.

    Args:
        uri: ``reader:rest``.

    Returns:
        The URI with its paths from the root and ``~`` replaced; as it is where the reader takes no path.

    Raises:
        InputError: ``~NAME`` names no user.

    >>> make_log_absolute("synthetic:street?seed=1"), make_log_absolute("pandaset:/data/002")
    ('synthetic:street?seed=1', 'pandaset:/data/002')
    """
    name, _, rest = uri.partition(":")
    entry = _READERS.get(name)
    # A reader that somebody registered may take anything, so its example decides.
    if entry is None or not entry.example.startswith(f"{name}:PATH"):
        return uri
    path, mark, query = rest.partition("?")
    options = "&".join(_make_option_absolute(option, entry) for option in query.split("&"))
    return f"{name}:{_make_path_absolute(path, entry)}{mark}{options}"


def _make_option_absolute(option: str, entry: ReaderEntry) -> str:
    key, equals, value = option.partition("=")
    if key not in entry.path_options or not value:
        return option
    return f"{key}{equals}{_make_path_absolute(value, entry)}"


def _make_path_absolute(text: str, entry: ReaderEntry) -> Path:
    first, *rest = Path(text).parts or (".",)
    if Path(text).is_absolute():
        return Path(text)
    # What is put before the user's text is not written by the user: a folder's name may look like an address.
    start = expand_user_path(first) if first.startswith("~") else Path.cwd()
    before = Path(quote_path(str(start))) if entry.is_quoted else start
    return before.joinpath(*rest) if first.startswith("~") else before / text


def takes_quoted_paths(reader: str) -> bool:
    """Says whether a reader's paths have special characters written with %, and options behind a question mark.

    Args:
        reader: the name before the colon of a URI.

    Returns:
        Whether they have; false for a reader that nobody registered.

    >>> takes_quoted_paths("kitti"), takes_quoted_paths("pandaset")
    (True, False)
    """
    return reader in _READERS and _READERS[reader].is_quoted


def quote_path(path: str) -> str:
    """Writes a path as readers of quoted paths take it.

    Args:
        path: the path of a file or a folder.

    Returns:
        The path with what is special in a log's address written with %.

    >>> quote_path("/data/100% done")
    '/data/100%25 done'
    """
    for character in "%?&":
        path = path.replace(character, f"%{ord(character):02X}")
    return path


def list_logs(uri: str) -> list[str] | None:
    """Lists the logs that a pattern stands for, where the logs of a reader are no folders.

    Args:
        uri: ``reader:rest`` with stars, such as ``nuscenes:PATH/*``.

    Returns:
        Their URIs; ``None`` where the reader's logs are folders, or there is no such reader.

    Raises:
        InputError: the reader cannot list them.

    >>> list_logs("pandaset:PATH/*") is None
    True
    """
    name, _, rest = uri.partition(":")
    entry = _READERS.get(name)
    if entry is None or not entry.lister:
        return None
    found: list[str] = _import_function(entry, entry.lister, uri)(rest)
    return [f"{name}:{log}" for log in found]


def _import_function(entry: ReaderEntry, target: str, uri: str) -> Callable[[str], Any]:
    module_name, _, function = target.partition(":")
    # Imported here, since a reader may need packages that users of other readers do not have.
    try:
        found: Callable[[str], Any] = getattr(importlib.import_module(module_name), function)
    except ImportError as error:
        remedy = f"Install what it needs: {entry.install_hint}."
        reader = uri.partition(":")[0]
        raise InputError(f"the reader {reader!r} cannot be loaded ({error})", remedy=remedy, log=uri) from error
    return found
