"""Writes training sets: one function for all layouts, and their names."""

from __future__ import annotations

import importlib
import shutil
import uuid
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

from genre_tasks.atomic_path import holds_files, replace_folder
from genre_tasks.errors import ConfigError, InputError, ResourceError
from genre_tasks.suggestions import did_you_mean
from genre_tasks.temporary_names import describe_owner, remove_abandoned
from genre_tasks.training_sets.labelled_images import LabelledImage

# Text, since a writer imports what its layout needs.
_WRITERS = {
    "coco": "genre_tasks.training_sets.coco_writer:CocoWriter",
    "kitti": "genre_tasks.training_sets.kitti_writer:KittiWriter",
    "nuscenes": "genre_tasks.training_sets.nuscenes_writer:NuScenesWriter",
    "own": "genre_tasks.training_sets.parquet_writer:ParquetWriter",
}


class SetWriter(Protocol):
    """Writes one training set into a folder that it is made with, image by image."""

    def add(self, labelled: LabelledImage) -> None:
        """Writes an image; its pixels are not kept."""
        ...

    def finish(self) -> None:
        """Writes what is about all images, such as tables."""
        ...


@dataclass(frozen=True)
class WrittenSet:
    """What a training set holds.

    Attributes:
        images: how many.
        boxes: of all images; a layout may leave out those that its images do not show.
    """

    images: int
    boxes: int


def training_set_formats() -> tuple[str, ...]:
    """Lists the names of layouts.

    >>> training_set_formats()
    ('coco', 'kitti', 'nuscenes', 'own')
    """
    return tuple(sorted(_WRITERS))


def check_training_set_format(name: str) -> None:
    """Checks the name of a layout.

    Args:
        name: what the user wrote.

    Raises:
        ConfigError: there is no such layout.

    >>> check_training_set_format("koco")
    Traceback (most recent call last):
    genre_tasks.errors.ConfigError: unknown training set format 'koco'. Did you mean 'coco'? Known: coco, kitti, ...
    """
    if name not in _WRITERS:
        remedy = f"{did_you_mean(name, _WRITERS)}Known: {', '.join(training_set_formats())}."
        raise ConfigError(f"unknown training set format {name!r}", remedy=remedy)


def check_new_folder(out: Path) -> None:
    """Checks that a folder holds nothing yet.

    Args:
        out: may be missing.

    Raises:
        InputError: it holds something, or is a file.
    """
    if out.exists() and (not out.is_dir() or any(out.iterdir())):
        remedy = "Give a folder that does not exist yet, or remove this one first."
        raise InputError("the folder to write holds something already", remedy=remedy, file=out)


def write_training_set(images: Iterable[LabelledImage], out: Path, format_name: str) -> WrittenSet:
    """Writes a training set; the folder appears complete or not at all.

    Args:
        images: taken one at a time, so that they may be more than memory holds.
        out: the new folder; missing or empty.
        format_name: coco, kitti, nuscenes or own.

    Returns:
        How much was written.

    Raises:
        ConfigError: there is no such format.
        InputError: the folder holds something already, or there is no image; what ``images`` raises goes through.
        ResourceError: the disk is full or not writable.
    """
    check_training_set_format(format_name)
    check_new_folder(out)
    module, _, name = _WRITERS[format_name].partition(":")
    image_count = 0
    box_count = 0
    with _new_folder(out) as root:
        writer: SetWriter = getattr(importlib.import_module(module), name)(root)
        for labelled in images:
            with _disk_errors(out):
                writer.add(labelled)
            image_count += 1
            box_count += len(labelled.boxes)
        # Trainers fail on an empty set much later, and without a reason.
        if not image_count:
            raise InputError("there is no image to write", remedy="Choose other frames or shifts.", file=out)
        with _disk_errors(out):
            writer.finish()
    return WrittenSet(image_count, box_count)


@contextmanager
def _new_folder(out: Path) -> Iterator[Path]:
    """A temporary folder next to the wanted one, which takes its place when the block ends."""
    # Next to the target, since only a rename within one file system is atomic.
    held_files = holds_files(out)
    part = out.parent / f".{out.name}.{describe_owner()}-{uuid.uuid4().hex[:8]}.part"
    with _disk_errors(out):
        out.parent.mkdir(parents=True, exist_ok=True)
        remove_abandoned(out.parent)
        part.mkdir()
    try:
        yield part
        with _disk_errors(out):
            replace_folder(out, part, held_files)
    finally:
        # After a success there is nothing left to remove.
        shutil.rmtree(part, ignore_errors=True)


@contextmanager
def _disk_errors(out: Path) -> Iterator[None]:
    try:
        yield
    except OSError as error:
        problem = f"the training set could not be written ({error})"
        raise ResourceError(problem, remedy="Free space, or give another folder.", file=out) from error
