"""Whether a change of code changed results: two stores with runs of the same logs, before and after.

python -m benchmarks.tools.compare_stores BEFORE AFTER

Prints per chunk the difference of every metric's value, and of the images of ``novel_views`` and ``fnet`` in levels of
1/255 (the largest, and the fraction of channels that differ by more than 2).
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator
from pathlib import Path

import torch
from torch import Tensor

from genre_tasks.scene.novel_views import FixedViews, NovelViews
from storage.opening import open_store
from storage.store import Artifact, Store

LEVELS = 255.0
VISIBLE_LEVELS = 2
IMAGE_STAGES = ("novel_views", "fnet")


def newest_artifacts(store: Store) -> dict[tuple[str, str, int, str], Artifact]:
    """Finds the artifact that was made last, by dataset, log, chunk and stage."""
    # The last of equal keys wins in a dictionary, so sorting by time leaves the newest.
    artifacts = sorted(store.artifacts(), key=lambda a: a.manifest.created_at)
    return {(a.address.dataset, a.address.log, a.address.chunk, a.address.stage): a for a in artifacts}


def compare(before: Path, after: Path) -> Iterator[str]:
    """Compares two stores.

    Args:
        before: folder of the store of the old code.
        after: folder of the store of the new code.

    Returns:
        Lines in the order of logs and stages: for evaluations one for each metric, for images one with the
        differences, for other stages one with the seconds.

    Raises:
        ValueError: the stores have no artifact of the same log, chunk and stage.
    """
    old_store = open_store(str(before))
    new_store = open_store(str(after))
    old = newest_artifacts(old_store)
    new = newest_artifacts(new_store)
    # Keys are left out of the address: a change of code changes them, and is what is being compared.
    both = sorted(old.keys() & new.keys())
    # Two stores without a common artifact would print nothing, which looks like no difference.
    if not both:
        raise ValueError(f"no artifact of the same log, chunk and stage in {before} and {after}")
    for address in both:
        _, log, chunk, stage = address
        title = f"{log} chunk {chunk} {stage}"
        if stage.startswith("evaluate/"):
            yield from _compare_metrics(title, _metrics(old_store, old[address]), _metrics(new_store, new[address]))
        elif stage in IMAGE_STAGES:
            yield _compare_images(title, _images(old_store, old[address]), _images(new_store, new[address]))
        else:
            seconds = [artifacts[address].manifest.seconds for artifacts in (old, new)]
            yield f"{title:<45} seconds {seconds[0]:.2f} {seconds[1]:.2f}"


def _metrics(store: Store, artifact: Artifact) -> dict[str, float]:
    return {m.name: m.value for m in store.read(artifact).metrics}


def _images(store: Store, artifact: Artifact) -> Tensor:
    """Reads images [V, H, W, 3], sRGB."""
    value: NovelViews | FixedViews = store.read(artifact)
    return value.color


def _compare_metrics(title: str, old: dict[str, float], new: dict[str, float]) -> Iterator[str]:
    for name in old:
        # Metrics may be added or removed between the versions.
        if name in new:
            yield f"{title:<45} {name:<28} {old[name]:10.4f} {new[name]:10.4f} {new[name] - old[name]:+.4f}"


def _compare_images(title: str, old: Tensor, new: Tensor) -> str:
    levels = (old - new).abs() * LEVELS
    # Truth values have no mean of their own, and doubles count millions of pixels exactly.
    visible = (levels > VISIBLE_LEVELS).double().mean()
    return f"{title:<45} levels of 1/255: largest {levels.max():.2f}, share above {VISIBLE_LEVELS} {visible:.2e}"


def main() -> None:
    """Runs the command line, see the top of this module."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("before", type=Path, help="folder of the store of the old code")
    parser.add_argument("after", type=Path, help="folder of the store of the new code")
    options = parser.parse_args()
    # Reading a store needs no threads, and the machine may be measuring something else.
    torch.set_num_threads(1)
    for line in compare(options.before, options.after):
        sys.stdout.write(line + "\n")


if __name__ == "__main__":
    main()
