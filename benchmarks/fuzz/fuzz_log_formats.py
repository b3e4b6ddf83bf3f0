"""The readers of logs and of files that people write: JSON, COLMAP, pickles, pictures, YAML."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.fuzz import fuzz_attacks, fuzz_samples
from benchmarks.fuzz.fuzz_mutations import BYTES, JSON, TEXT
from benchmarks.fuzz.fuzz_target import IMAGE_MEMORY_MIB, FuzzTarget, give_samples, require_sound


def json_targets() -> Iterator[FuzzTarget]:
    """Lists the readers of JSON and of models of COLMAP."""
    from flows.reconstruction.record_files import read_record
    from flows.simulation.path_file import read_path_file
    from genre_tasks.ego_paths.ego_path import EgoPath
    from genre_tasks.json_files import read_json_object
    from genre_tasks.logs.file_reading import read_entries, read_times
    from genre_tasks.logs.pandaset.layout import parse_pose
    from genre_tasks.logs.posed_images.transforms_json import read_transforms

    def read_poses(path: Path) -> object:
        entries = read_entries(path, "log")
        return [parse_pose(entry, file=path, log="log", frame=frame) for frame, entry in enumerate(entries)]

    poses = np.broadcast_to(np.eye(4), (3, 4, 4)).copy()
    recorded = EgoPath(np.arange(3.0), np.arange(3.0), poses)
    rows = [{"time_s": 0.5 * k, "lateral_m": 0.5, "ahead_m": 0.0} for k in range(4)]
    readers: tuple[tuple[str, str, Any, Callable[[Path], object]], ...] = (
        ("read_json_object", "x.json", fuzz_samples.make_run_record(), partial(_read_object, read_json_object)),
        ("read_record", "run.json", fuzz_samples.make_run_record(), read_record),
        ("read_transforms", "transforms.json", fuzz_samples.make_transforms(), read_transforms),
        ("read_path_file", "path.json", rows, lambda path: read_path_file(path, recorded)),
        ("parse_pose", "poses.json", fuzz_samples.make_sequence_poses(), read_poses),
        ("read_times", "timestamps.json", [1.5e9, 1.5e9 + 0.1], lambda path: read_times(path, "log")),
        ("list_pins", "pin.json", {"name": "n", "keys": ["a"], "note": "", "pinned_at": "t"}, _read_pins),
    )
    for name, file, value, read in readers:
        yield FuzzTarget("JSON", name, file, give_samples(fuzz_samples.dump(value)), read, JSON)
    for file in ("cameras.bin", "images.bin", "cameras.txt", "images.txt"):
        prepare = partial(fuzz_samples.write_colmap_model, file)
        read = _read_colmap
        yield FuzzTarget("COLMAP", "read_colmap_model", file, prepare, read, BYTES if file.endswith("bin") else TEXT, 5)


def _read_object(read: Callable[..., dict[str, Any]], path: Path) -> object:
    return read(path, "file", "Write it again.")


def _read_colmap(path: Path) -> object:
    from genre_tasks.logs.posed_images.colmap_model import read_colmap_model

    return read_colmap_model(path.parent)


def _read_pins(path: Path) -> object:
    from flows.upkeep.pins import PINS, list_pins
    from storage.local import LocalStore

    folder = path.parent / "store" / PINS / "n"
    folder.mkdir(parents=True, exist_ok=True)
    shutil.copyfile(path, folder / "pin.json")
    return list_pins(LocalStore(path.parent / "store"))


def pickle_targets() -> Iterator[FuzzTarget]:
    """Lists the readers of PandaSet's pickles."""
    from genre_tasks.logs.pandaset.cuboids import build_tracks, read_boxes
    from genre_tasks.logs.pandaset.pickle_reader import read_table
    from genre_tasks.logs.pandaset.sweeps import build_sweep

    def read(path: Path) -> object:
        table = read_table(path, log="log", frame=0)
        require_sound(all(len(c) == table.row_count for c in table.columns.values()), "columns of one length")
        if "x" in table.columns:
            return build_sweep(table, 0, file=path, log="log")
        return build_tracks([read_boxes(table, 0, file=path, log="log")], "log")

    damages = (*BYTES, *(fuzz_attacks.make_running_pickle,) * 3, *(fuzz_attacks.change_pickle,) * 8)
    damages += (fuzz_attacks.compress_pickle, fuzz_attacks.compress_pickle, *(fuzz_attacks.make_odd_table,) * 4)
    yield FuzzTarget("pickle", "read_table", "00.pkl", give_samples(*fuzz_samples.pickle_tables()), read, damages, 90)
    bombs = (fuzz_attacks.make_long_pickle,)
    yield FuzzTarget(
        "pickle", "read_table, long", "00.pkl", give_samples(*fuzz_samples.pickle_tables()), read, bombs, 1, 640
    )


def image_targets() -> Iterator[FuzzTarget]:
    """Lists the readers of JPEG and PNG."""
    from genre_tasks.logs.image_sizes import measure_images
    from genre_tasks.scene.image_decoding import decode_with_facts, inspect_image, read_image_size
    from storage.codecs.png import read_png

    def read(path: Path) -> object:
        data = path.read_bytes()
        measure_images({0: path})
        width, height = read_image_size(data)
        inspect_image(data)
        image = decode_with_facts(data, 16, 9)
        require_sound(image.pixels.shape == (9, 16, 3) and width > 0 and height > 0, "pixels of the asked size")
        return image

    for kind, change, name in (
        ("JPEG", fuzz_attacks.change_jpeg, "0.jpg"),
        ("PNG", fuzz_attacks.change_png, "0.png"),
    ):
        samples = give_samples(*fuzz_samples.encode_pictures(kind))
        damages = (*BYTES, *(change,) * 5)
        yield FuzzTarget(kind, "decode_with_facts", name, samples, read, damages, 70, IMAGE_MEMORY_MIB)
    others = give_samples(*fuzz_samples.encode_other_pictures())
    yield FuzzTarget("other pictures", "decode_with_facts", "0.jpg", others, read, BYTES, 30, IMAGE_MEMORY_MIB)
    picture = give_samples(fuzz_samples.encode_pictures("PNG")[0])
    damages = (*BYTES, *(fuzz_attacks.change_png,) * 5)
    yield FuzzTarget("PNG", "read_png", "0.png", picture, read_png, damages, 20, IMAGE_MEMORY_MIB)


def yaml_targets() -> Iterator[FuzzTarget]:
    """Lists the readers of YAML."""
    from flows.configuration.loading import load_configuration
    from flows.simulation.edit_file import read_edit_file
    from flows.yaml_values import read_yaml_mapping

    edits = b"edits:\n  - remove: car-3\n  - move: car-4\n    forward_m: 2.5\n    left_m: -1\n"
    edits += b"  - retime: car-5\n    delay_s: 0.5\n"
    settings = b"gnet:\n  iterations: 24\n  snapshots: 0\ningest:\n  width_px: 320\n  height_px: 180 # half\n"
    settings += b"novel_views:\n  shifts_m: [1.0, -3]\neffects: auto\n"
    damages = (*TEXT, *(fuzz_attacks.attack_yaml,) * 6)

    def read(path: Path) -> object:
        return read_yaml_mapping(path, "file", "keys", "Write keys.")

    yield FuzzTarget("YAML", "read_yaml_mapping", "x.yaml", give_samples(settings, edits), read, damages, 40)
    yield FuzzTarget("YAML", "read_edit_file", "edits.yaml", give_samples(edits), read_edit_file, damages, 25)
    yield FuzzTarget(
        "YAML",
        "load_configuration",
        "c.yaml",
        give_samples(settings),
        lambda path: load_configuration("small", path),
        damages,
        25,
    )
