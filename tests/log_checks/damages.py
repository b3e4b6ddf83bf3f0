"""Random damage to a PandaSet folder, of the kinds that people's logs have: a list that hypothesis draws from."""

from __future__ import annotations

import gzip
import json
import random
import shutil
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from genre_tasks.logs.pandaset.pickle_reader import read_table
from tests.logs.pandaset_folder import write_table

JSON_FILES = ("lidar/poses.json", "lidar/timestamps.json", "meta/timestamps.json")
CAMERA_JSON_FILES = ("poses.json", "timestamps.json", "intrinsics.json")
# Values of other types than a reader expects, or of none.
ODD_VALUES = (
    None,
    "text",
    "",
    True,
    -1,
    0,
    1e300,
    10**30,
    float("nan"),
    [],
    {},
    [[]],
    {"x": {}},
    "2019-05-06T21:46:00",
)


@dataclass(frozen=True)
class Damage:
    """One thing that is done to a log.

    Attributes:
        kind: name of the function in :data:`KINDS`.
        seed: chooses file, entry and strength.
    """

    kind: str
    seed: int

    def apply(self, folder: Path) -> None:
        """Damages the log in ``folder``."""
        KINDS[self.kind](folder, random.Random(self.seed))


def json_files(folder: Path) -> list[Path]:
    cameras = [folder / "camera" / camera.name / name for camera in cameras_of(folder) for name in CAMERA_JSON_FILES]
    return [path for path in (*(folder / name for name in JSON_FILES), *cameras) if path.is_file()]


def cameras_of(folder: Path) -> list[Path]:
    return sorted(path for path in (folder / "camera").iterdir() if path.is_dir())


def images_of(folder: Path) -> list[Path]:
    return sorted(folder.glob("camera/*/*.png"))


def tables_of(folder: Path) -> list[Path]:
    return sorted((*folder.glob("lidar/*.pkl.gz"), *folder.glob("annotations/cuboids/*.pkl.gz")))


def data_files(folder: Path) -> list[Path]:
    return [*json_files(folder), *images_of(folder), *tables_of(folder)]


def _paths_in(value: Any, prefix: tuple[Any, ...] = ()) -> list[tuple[Any, ...]]:
    """Every place in a JSON value, as the keys that lead there."""
    children: list[tuple[Any, Any]] = []
    if isinstance(value, dict):
        children = list(value.items())
    elif isinstance(value, list):
        children = list(enumerate(value))
    return [prefix, *(path for key, child in children for path in _paths_in(child, (*prefix, key)))]


def _edit(path: Path, change: Callable[[Any], Any]) -> None:
    path.write_text(json.dumps(change(json.loads(path.read_text()))))


def _replace(value: Any, path: tuple[Any, ...], new: Any) -> Any:
    if not path:
        return new
    value[path[0]] = _replace(value[path[0]], path[1:], new)
    return value


def change_type(folder: Path, chance: random.Random) -> None:
    """Another type at some place of a JSON file."""
    file = chance.choice(json_files(folder))
    _edit(file, lambda value: _replace(value, chance.choice(_paths_in(value)), chance.choice(ODD_VALUES)))


def remove_entry(folder: Path, chance: random.Random) -> None:
    """An entry of a list or a key of a mapping is not there."""
    file = chance.choice(json_files(folder))

    def remove(value: Any) -> Any:
        path = chance.choice([path for path in _paths_in(value) if path] or [()])
        if not path:
            return value
        parent = value
        for key in path[:-1]:
            parent = parent[key]
        del parent[path[-1]]
        return value

    _edit(file, remove)


def scale_unit(folder: Path, chance: random.Random) -> None:
    """One quantity in another unit, everywhere in the log or in one file."""
    factor = chance.choice((0.001, 0.01, 0.3048, 0.5, 2.0, 100.0, 1000.0))
    quantity = chance.choice(("positions", "times", "focal", "points", "boxes", "one camera's positions"))
    if quantity in ("positions", "one camera's positions"):
        files = [folder / "lidar/poses.json", *(camera / "poses.json" for camera in cameras_of(folder))]
        for file in files if quantity == "positions" else files[1:2]:
            _edit(file, lambda poses: [_scaled_position(pose, factor) for pose in poses])
    elif quantity == "times":
        file = chance.choice([path for path in json_files(folder) if path.name == "timestamps.json"])
        _edit(file, lambda times: [time * factor for time in times])
    elif quantity == "focal":
        file = chance.choice(cameras_of(folder)) / "intrinsics.json"
        _edit(file, lambda lens: {**lens, "fx": lens["fx"] * factor, "fy": lens["fy"] * factor})
    else:
        names = ("x", "y", "z") if quantity == "points" else ("dimensions.x", "dimensions.y", "dimensions.z")
        for file in tables_of(folder):
            columns = dict(read_table(file).columns)
            if names[0] in columns:
                write_table(file, columns | {name: columns[name] * factor for name in names})


def _scaled_position(pose: dict[str, Any], factor: float) -> dict[str, Any]:
    return {**pose, "position": {axis: value * factor for axis, value in pose["position"].items()}}


def turn_quaternions(folder: Path, chance: random.Random) -> None:
    """Quaternions in another order, or of the inverse rotation."""
    swap = chance.choice(("xyzw", "conjugate"))

    def turned(heading: dict[str, float]) -> dict[str, float]:
        if swap == "xyzw":
            return dict(zip("wxyz", (heading[name] for name in "xyzw"), strict=True))
        return {name: value if name == "w" else -value for name, value in heading.items()}

    for file in json_files(folder):
        if file.name == "poses.json":
            _edit(file, lambda poses: [{**pose, "heading": turned(pose["heading"])} for pose in poses])


def rename_frames(folder: Path, chance: random.Random) -> None:
    """Files of one kind under other names: more digits, counted from one, another suffix, other case."""
    files = chance.choice((images_of(folder), tables_of(folder)))
    change = chance.choice(("digits", "from one", "upper", "underscore"))
    # From the last to the first, so that a new name is free.
    for file in reversed(files):
        stem, dot, suffix = file.name.partition(".")
        name = {
            "digits": f"{int(stem):06d}{dot}{suffix}",
            "from one": f"{int(stem) + 1:02d}{dot}{suffix}",
            "upper": f"{stem}{dot}{suffix.upper()}",
            "underscore": f"frame_{stem}{dot}{suffix}",
        }[change]
        file.rename(file.with_name(name))


def swap_frames(folder: Path, chance: random.Random) -> None:
    """Two frames of one kind are exchanged, or all are shifted by one."""
    files = chance.choice([sorted(camera.glob("*.png")) for camera in cameras_of(folder)] + [tables_of(folder)[:8]])
    contents = [file.read_bytes() for file in files]
    moved = [*contents[1:], contents[0]] if chance.random() < 0.5 else contents[::-1]
    for file, content in zip(files, moved, strict=True):
        file.write_bytes(content)


def truncate(folder: Path, chance: random.Random) -> None:
    """A file ends early."""
    file = chance.choice(data_files(folder))
    file.write_bytes(file.read_bytes()[: int(file.stat().st_size * chance.choice((0.0, 0.01, 0.5, 0.99)))])


def spoil_bytes(folder: Path, chance: random.Random) -> None:
    """Some bytes of a file are others."""
    file = chance.choice(data_files(folder))
    content = bytearray(file.read_bytes())
    for _ in range(chance.choice((1, 10, 100))):
        content[chance.randrange(len(content))] = chance.randrange(256)
    file.write_bytes(bytes(content))


def remove_file(folder: Path, chance: random.Random) -> None:
    """A file, or a folder, is not there."""
    target = chance.choice([*data_files(folder), *cameras_of(folder), folder / "lidar", folder / "annotations"])
    if target.is_dir():
        shutil.rmtree(target)
    else:
        target.unlink()


def replace_by_other_thing(folder: Path, chance: random.Random) -> None:
    """A file is a folder, a link to nowhere, a link to itself, a web page, or a pointer of Git LFS."""
    file = chance.choice(data_files(folder))
    file.unlink()
    kind = chance.choice(("folder", "nowhere", "itself", "page", "pointer"))
    if kind == "folder":
        file.mkdir()
    elif kind == "nowhere":
        file.symlink_to(folder / "nowhere")
    elif kind == "itself":
        file.symlink_to(file)
    elif kind == "page":
        file.write_text("<!DOCTYPE html><html><body>404</body></html>")
    else:
        file.write_text(f"version https://git-lfs.github.com/spec/v1\noid sha256:{1:064d}\nsize 12345\n")


def take_permission(folder: Path, chance: random.Random) -> None:
    """A file or folder may not be read; for root, who may read everything, there is a directory in its place."""
    file = chance.choice(data_files(folder))
    file.chmod(0)


def spoil_column(folder: Path, chance: random.Random) -> None:
    """A column of a table is missing, of another type, not finite, or huge."""
    file = chance.choice(tables_of(folder))
    columns = dict(read_table(file).columns)
    if not columns:
        return
    name = chance.choice(sorted(columns))
    count = len(columns[name])
    change = chance.choice(("missing", "text", "nan", "huge", "zero", "integers"))
    if change == "missing":
        del columns[name]
    else:
        columns[name] = {
            "text": np.array(["?"] * count, dtype=object),
            "nan": np.full(count, np.nan),
            "huge": np.full(count, 1e30),
            "zero": np.zeros(count),
            "integers": np.arange(count),
        }[change]
    write_table(file, columns)


def write_other_pickle(folder: Path, chance: random.Random) -> None:
    """A pickle that holds something else than a table."""
    import pickle

    file = chance.choice(tables_of(folder))
    value = chance.choice(([1, 2], {"x": 1}, None, "text", np.zeros(3), print))
    file.write_bytes(gzip.compress(pickle.dumps(value)))


KINDS: dict[str, Callable[[Path, random.Random], None]] = {
    function.__name__: function
    for function in (
        change_type,
        remove_entry,
        scale_unit,
        turn_quaternions,
        rename_frames,
        swap_frames,
        truncate,
        spoil_bytes,
        remove_file,
        replace_by_other_thing,
        take_permission,
        spoil_column,
        write_other_pickle,
    )
}
