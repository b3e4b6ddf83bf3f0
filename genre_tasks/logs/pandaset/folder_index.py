"""What lies in a sequence folder, found by listing it once: which file belongs to which frame, and what is not read.

People rename, convert and sync their logs: suffixes in capitals, three digits for two, another image format, pickles
without gzip. Whatever can be read is read; whatever cannot is in the index too, so that it can be named.
"""

from __future__ import annotations

import os
import re
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from genre_tasks.logs.pandaset.layout import IMAGE_SUFFIXES, TABLE_SUFFIXES, frame_stem

CAMERA_FILES = ("intrinsics.json", "poses.json", "timestamps.json")
LIDAR_FILES = ("poses.json", "timestamps.json")

# Longer numbers are times.
_FRAME_NAME = re.compile(r"([0-9]{1,9})(\..+)")
# What systems, editors and programs that copy leave behind; never a part of a log.
_LITTER_NAMES = frozenset(
    {"thumbs.db", "ehthumbs.db", "desktop.ini", "icon\r", "__macosx", "@eadir", "$recycle.bin", "lost+found"}
    | {"system volume information", "__pycache__"}
)
_LITTER_SUFFIXES = ("~", ".tmp", ".temp", ".swp", ".bak", ".lock")

Kind = str
_FILE: Kind = "file"
_FOLDER: Kind = "folder"
_BROKEN_LINK: Kind = "a link that leads nowhere"
_OTHER: Kind = "neither file nor folder"


@dataclass(frozen=True)
class FrameFolder:
    """A folder with one file for every frame, such as a camera's.

    Attributes:
        path: the folder; it may not exist.
        files: frame → its file.
        rivals: frame → names of further files for that frame, which are not read.
        settings: name of a JSON file, as the layout has it → the file.
        unread: names of everything else, without litter; what is no file says so.
    """

    path: Path
    files: Mapping[int, Path]
    rivals: Mapping[int, tuple[str, ...]]
    settings: Mapping[str, Path]
    unread: tuple[str, ...]

    def setting(self, name: str) -> Path:
        """The path of a JSON file, whether it exists or not.

        Args:
            name: as the layout has it.

        Returns:
            The file as it is spelled in the folder, or where it is expected.
        """
        return self.settings.get(name, self.path / name)


@dataclass(frozen=True)
class SequenceIndex:
    """What lies in a sequence folder.

    Attributes:
        root: the sequence folder.
        cameras: name → its folder, with intrinsics or without.
        lidar: sweeps.
        cuboids: annotations.
        unread: ``.``, ``camera`` and ``annotations`` → names in that folder that are not read.
        respelled: (found, expected) names of folders in other capitals.
        unlistable: (folder, why) that could not be listed.
    """

    root: Path
    cameras: Mapping[str, FrameFolder]
    lidar: FrameFolder
    cuboids: FrameFolder
    unread: Mapping[str, tuple[str, ...]]
    respelled: tuple[tuple[str, str], ...]
    unlistable: tuple[tuple[str, str], ...]

    def read_files(self, frame_count: int) -> list[Path]:
        """Lists the files that the reader reads.

        Args:
            frame_count: frames of the log; files of other frames are not read.

        Returns:
            The files, in no particular order.
        """
        folders = [folder for folder in self.cameras.values() if "intrinsics.json" in folder.settings]
        return [
            path
            for folder in (*folders, self.lidar, self.cuboids)
            for path in (*folder.settings.values(), *(folder.files[f] for f in folder.files if f < frame_count))
        ]


def index_sequence(root: Path) -> SequenceIndex:
    """Lists a sequence folder, and the folders of its cameras, LiDAR and cuboids.

    Args:
        root: the sequence folder.

    Returns:
        What lies in it. A folder that cannot be listed is empty here, and named in ``unlistable``.
    """
    return _Indexer(root).index()


def is_litter(name: str) -> bool:
    """Tells whether a file was left by a system, an editor or a copying program.

    Args:
        name: of the file, without its folder.

    Returns:
        True for hidden files, thumbnails, temporary and backup files.

    >>> [name for name in (".DS_Store", "._00.png", "Thumbs.db", "00.png~", "00.png") if not is_litter(name)]
    ['00.png']
    """
    lower = name.casefold()
    return name.startswith((".", "~$", "#")) or lower in _LITTER_NAMES or lower.endswith(_LITTER_SUFFIXES)


class _Indexer:
    """Lists folders, and remembers what was odd about them."""

    def __init__(self, root: Path) -> None:
        self.root = root
        self.respelled: list[tuple[str, str]] = []
        self.unlistable: list[tuple[str, str]] = []

    def index(self) -> SequenceIndex:
        top = self._list(self.root)
        camera = self._find_folder(self.root, top, "camera")
        lidar = self._find_folder(self.root, top, "lidar")
        annotations = self._find_folder(self.root, top, "annotations")
        in_camera = self._list(camera)
        in_annotations = self._list(annotations)
        cuboids = self._find_folder(annotations, in_annotations, "cuboids")
        camera_folders = [name for name, kind in in_camera.items() if kind == _FOLDER]
        read = {folder.name for folder in (camera, lidar, annotations)}
        return SequenceIndex(
            root=self.root,
            cameras={name: self._index_frames(camera / name, IMAGE_SUFFIXES, CAMERA_FILES) for name in camera_folders},
            lidar=self._index_frames(lidar, TABLE_SUFFIXES, LIDAR_FILES),
            cuboids=self._index_frames(cuboids, TABLE_SUFFIXES, ()),
            unread={
                ".": _describe_entries(top, lambda name: name not in read),
                "camera": _describe_entries(in_camera, lambda name: name not in camera_folders),
                "annotations": _describe_entries(in_annotations, lambda name: name != cuboids.name),
            },
            respelled=tuple(self.respelled),
            unlistable=tuple(self.unlistable),
        )

    def _list(self, folder: Path) -> dict[str, Kind]:
        """Name → kind of what lies in a folder, without litter, sorted by name."""
        try:
            with os.scandir(folder) as entries:
                kinds = {entry.name: _find_kind(entry) for entry in entries if not is_litter(entry.name)}
        except FileNotFoundError:
            return {}
        except OSError as error:
            self.unlistable.append((folder.relative_to(self.root).as_posix(), error.strerror or str(error)))
            return {}
        return dict(sorted(kinds.items()))

    def _find_folder(self, parent: Path, entries: Mapping[str, Kind], expected: str) -> Path:
        """The folder of that name, in whatever capitals; where it would be if there is none."""
        name = _find_spelling(entries, expected, _FOLDER)
        if name != expected and name in entries:
            folder = parent.relative_to(self.root)
            self.respelled.append(((folder / name).as_posix(), (folder / expected).as_posix()))
        return parent / name

    def _index_frames(self, folder: Path, suffixes: tuple[str, ...], expected_settings: Iterable[str]) -> FrameFolder:
        entries = self._list(folder)
        spellings = {name: _find_spelling(entries, name, _FILE) for name in expected_settings}
        settings = {name: folder / found for name, found in spellings.items() if entries.get(found) == _FILE}
        candidates: dict[int, list[str]] = {}
        for name, kind in entries.items():
            match = _FRAME_NAME.fullmatch(name)
            if match is not None and kind == _FILE and match[2].lower() in suffixes:
                candidates.setdefault(int(match[1]), []).append(name)
        for frame, names in candidates.items():
            names.sort(key=partial(_rank, frame=frame, suffixes=suffixes))
        used = {name for names in candidates.values() for name in names} | {path.name for path in settings.values()}
        return FrameFolder(
            path=folder,
            files={frame: folder / names[0] for frame, names in sorted(candidates.items())},
            rivals={frame: tuple(names[1:]) for frame, names in sorted(candidates.items()) if len(names) > 1},
            settings=settings,
            unread=_describe_entries(entries, lambda name: name not in used),
        )


def _find_kind(entry: os.DirEntry[str]) -> Kind:
    try:
        if entry.is_file():
            return _FILE
        if entry.is_dir():
            return _FOLDER
        return _BROKEN_LINK if entry.is_symlink() else _OTHER
    except OSError:
        # A link that leads to itself, or into a folder that may not be entered.
        return _BROKEN_LINK


def _find_spelling(entries: Mapping[str, Kind], expected: str, kind: Kind) -> str:
    """How a folder spells a name: as expected, else in other capitals."""
    found = [name for name, found_kind in entries.items() if name.lower() == expected and found_kind == kind]
    return found[0] if found and expected not in found else expected


def _rank(name: str, frame: int, suffixes: tuple[str, ...]) -> tuple[bool, int, str]:
    """Orders the files of one frame: the layout's spelling first, then by suffix."""
    suffix = name[name.index(".") :]
    is_layout = name == f"{frame_stem(frame)}{suffix.lower()}"
    return (not is_layout, suffixes.index(suffix.lower()), name)


def _describe_entries(entries: Mapping[str, Kind], is_unread: Callable[[str], bool]) -> tuple[str, ...]:
    marks = {_FILE: "", _FOLDER: "/", _BROKEN_LINK: f" ({_BROKEN_LINK})", _OTHER: f" ({_OTHER})"}
    return tuple(f"{name}{marks[kind]}" for name, kind in entries.items() if is_unread(name))
