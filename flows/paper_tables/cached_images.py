"""Labelled images that several trainings share: made once, and kept as training sets that anyone can open."""

from __future__ import annotations

import hashlib
import json
import shutil
import uuid
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from storage.code_digest import code_digest

if TYPE_CHECKING:
    from genre_tasks.training_sets.labelled_images import LabelledImage

_CODE = ("genre_tasks.training_sets.label_boxes", "genre_tasks.training_sets.writing", "genre_tasks.render")


@dataclass(frozen=True)
class CachedImages:
    """The images of one chunk and kind.

    Attributes:
        key: names all that the images follow from.
        folder: of the training set, in the layout ``own``.
        make: makes the images where the folder is missing.
    """

    key: str
    folder: Path
    make: Callable[[], Sequence[LabelledImage]]

    @staticmethod
    def named(root: Path, names: Sequence[Any], make: Callable[[], Sequence[LabelledImage]]) -> CachedImages:
        """Names a set by what its images follow from.

        Args:
            root: folder of all sets.
            names: JSON values.
            make: makes the images.
        """
        # A label's rule may change as well as its scene.
        key = digest_values(list(names), _CODE)
        return CachedImages(key, root / "images" / f"{names[0]}-{key}", make)

    def read(self) -> list[LabelledImage]:
        """Reads the images; their pixels are read when they are asked for.

        Raises:
            InputError: the set is damaged, or the images cannot be made.
        """
        from genre_tasks.training_sets.reading import read_training_set
        from genre_tasks.training_sets.writing import write_training_set

        # A set appears complete or not at all, so that a folder is enough to know.
        if not self.folder.is_dir():
            finished = self.folder.with_name(f"{self.folder.name}.{uuid.uuid4().hex[:8]}")
            write_training_set(self.make(), finished, "own")
            _publish(finished, self.folder)
        return read_training_set(self.folder)


def _publish(finished: Path, folder: Path) -> None:
    """Gives a finished set its name; the first of several trainings that make the same one wins."""
    try:
        finished.rename(folder)
    except OSError:
        # Another training may have been faster, and its images are the same.
        if not folder.is_dir():
            raise
        shutil.rmtree(finished)


@dataclass(frozen=True)
class JoinedImages:
    """The images of several sets.

    Attributes:
        parts: the sets in order.
    """

    parts: tuple[CachedImages, ...]

    @property
    def key(self) -> str:
        """Names all that the images follow from."""
        return " ".join(part.key for part in self.parts)

    def read(self) -> list[LabelledImage]:
        """Reads the images of all sets, see :meth:`CachedImages.read`."""
        return [image for part in self.parts for image in part.read()]


def digest_values(values: Any, modules: Sequence[str]) -> str:
    """Names what follows from values and code.

    Args:
        values: JSON values.
        modules: of the code.

    Returns:
        24 hexadecimal digits.
    """
    code = code_digest(modules[0], lazy_modules=tuple(modules[1:]))
    return hashlib.sha256(json.dumps([values, code], sort_keys=True).encode()).hexdigest()[:24]
