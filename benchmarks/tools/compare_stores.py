"""Whether a change of code changed results: two stores with runs of the same logs, before and after.

python benchmarks/tools/compare_stores.py BEFORE AFTER

Prints per chunk the difference of every metric's value, and of the images of ``novel_views`` and ``fnet`` in levels of
1/255 (the largest, and the share of channels that differ by more than 2).
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator
from pathlib import Path

import torch
from torch import Tensor

from genre_tasks.scene.novel_views import FixedViews, NovelViews
from storage.local import open_store
from storage.store import Artifact, Store

LEVELS = 255.0
IMAGES = ("novel_views", "fnet")


def newest(store: Store) -> dict[tuple[str, str, int, str], Artifact]:
    """By dataset, log, chunk and stage: the artifact made last."""
    artifacts = sorted(store.artifacts(), key=lambda a: a.manifest.created_at)
    return {(a.address.dataset, a.address.log, a.address.chunk, a.address.stage): a for a in artifacts}


def images_of(store: Store, artifact: Artifact) -> Tensor:
    """[V, H, W, 3], display-referred."""
    value: NovelViews | FixedViews = store.read(artifact)
    return value.color


def compare(before: Path, after: Path) -> Iterator[str]:
    """A line for each difference, in the order of logs and stages. Raises ``ValueError`` for stores without a pair."""
    stores = open_store(str(before)), open_store(str(after))
    old, new = (newest(store) for store in stores)
    both = sorted(old.keys() & new.keys())
    if not both:
        raise ValueError(f"no artifact of the same log, chunk and stage in {before} and {after}")
    for where in both:
        title = f"{where[1]} chunk {where[2]} {where[3]}"
        if where[3].startswith("evaluate/"):
            was, now = (
                {m.name: m.value for m in s.read(a[where]).metrics} for s, a in zip(stores, (old, new), strict=True)
            )
            for name in was.keys() & now.keys():
                yield f"{title:<45} {name:<28} {was[name]:10.4f} {now[name]:10.4f} {now[name] - was[name]:+.4f}"
        elif where[3] in IMAGES:
            a, b = (images_of(s, x[where]) for s, x in zip(stores, (old, new), strict=True))
            levels = (a - b).abs() * LEVELS
            share = (levels > 2).double().mean()
            yield f"{title:<45} levels of 1/255: largest {levels.max():.2f}, share above 2 {share:.2e}"
        else:
            seconds = [a[where].manifest.seconds for a in (old, new)]
            yield f"{title:<45} seconds {seconds[0]:.2f} {seconds[1]:.2f}"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("before", type=Path)
    parser.add_argument("after", type=Path)
    options = parser.parse_args()
    torch.set_num_threads(1)
    for line in compare(options.before, options.after):
        sys.stdout.write(line + "\n")


if __name__ == "__main__":
    main()
