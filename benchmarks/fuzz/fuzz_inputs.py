"""The inputs of a run by their index: which reader gets them, and how the file is damaged."""

from __future__ import annotations

from pathlib import Path
from random import Random

from benchmarks.fuzz.fuzz_formats import list_targets
from benchmarks.fuzz.fuzz_mutations import keep
from benchmarks.fuzz.fuzz_target import FuzzTarget

UNCHANGED_EVERY = 40
"""One input in so many of a target is a valid file, which must be read."""

_TWICE = 0.15


class FuzzInputs:
    """Makes the inputs of a run; an input follows from seed and index alone.

    Args:
        seed: of all inputs.
        count: how many inputs there are.
        folder: that files are written to.
    """

    def __init__(self, seed: int, count: int, folder: Path) -> None:
        self._seed = seed
        self._folder = folder
        self._order = _share_out(list_targets(), count)
        # Shuffled, so that the first inputs are of all formats.
        Random(seed).shuffle(self._order)
        self._prepared: dict[str, list[bytes]] = {}

    def target(self, index: int) -> FuzzTarget:
        """Gives the target of an input."""
        return self._order[index % len(self._order)]

    def warm_up(self, start: int, stop: int) -> None:
        """Reads the valid files of some inputs' targets, so that imports count to no input.

        Args:
            start: the first index.
            stop: the index after the last one.
        """
        for target in {
            self.target(index).reader + self.target(index).file: self.target(index) for index in range(start, stop)
        }.values():
            folder = self._target_folder(target)
            path = folder / target.file
            for content in self._samples(target):
                path.write_bytes(content)
                target.read(path)

    def write(self, index: int) -> tuple[FuzzTarget, Path, str]:
        """Writes an input.

        Args:
            index: of the input.

        Returns:
            The target, the file, and the names of the damages; ``keep`` where the file is valid.
        """
        target = self.target(index)
        content, damage = self.content(index)
        path = self._target_folder(target) / target.file
        path.write_bytes(content)
        return target, path, damage

    def content(self, index: int) -> tuple[bytes, str]:
        """Makes the bytes of an input, and the names of its damages."""
        rng = Random(f"{self._seed} {index}")
        target = self.target(index)
        samples = self._samples(target)
        data = rng.choice(samples)
        if rng.randrange(UNCHANGED_EVERY) == 0:
            return data, keep.__name__
        damages = [rng.choice(target.damages)]
        if rng.random() < _TWICE:
            # Only one of them may need a sound structure.
            damages.append(rng.choice(target.damages[:5]))
        for damage in damages:
            data = damage(rng, data, samples)
        return data, " ".join(damage.__name__ for damage in damages)

    def _samples(self, target: FuzzTarget) -> list[bytes]:
        name = f"{target.format} {target.reader} {target.file}"
        if name not in self._prepared:
            self._prepared[name] = target.prepare(self._target_folder(target))
        return self._prepared[name]

    def _target_folder(self, target: FuzzTarget) -> Path:
        name = "".join(c if c.isalnum() else "_" for c in f"{target.format} {target.reader} {target.file}")
        folder = self._folder / name
        folder.mkdir(exist_ok=True)
        return folder


def _share_out(targets: tuple[FuzzTarget, ...], count: int) -> list[FuzzTarget]:
    """Targets in an order in which each stands as often as its share of ``count`` says, at least once."""
    total = sum(target.share for target in targets)
    order = []
    for target in targets:
        order += [target] * max(1, round(target.share * count / total))
    return order
