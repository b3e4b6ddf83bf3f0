"""Which views supervise an iteration: cameras in turn, each camera's views in shuffled order."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, TypeVar

import torch

from genre_tasks.losses.targets import Target

Item = TypeVar("Item")


class ViewSampler:
    """Draws some of the given views for each iteration.

    Cameras come in shuffled rounds, so that a full round sees every direction once. A camera's views come in shuffled
    order, without repetition until all were drawn.

    Args:
        targets: the views.
        count: how many to draw at a time; at or above their number, all of them in order.
        generator: it shuffles.

    Attributes:
        targets: the views.
        count: how many are drawn at a time.
    """

    def __init__(self, targets: Sequence[Target], count: int, generator: torch.Generator) -> None:
        self.targets = tuple(targets)
        self.count = min(count, len(self.targets))
        self._generator = generator
        self._views_of_camera: dict[str, list[int]] = {}
        for i, target in enumerate(self.targets):
            self._views_of_camera.setdefault(target.camera, []).append(i)
        # Rounds begin empty, so that nothing is drawn from the generator before the first iteration.
        self._camera_queue: list[str] = []
        self._view_queues: dict[str, list[int]] = {camera: [] for camera in self._views_of_camera}

    def draw(self) -> list[Target]:
        """Draws the next iteration's views.

        Returns:
            ``count`` views; none where there are none.
        """
        # No draw at all: two runs that see every view differ in nothing that a seed decides.
        if self.count == len(self.targets):
            return list(self.targets)
        drawn: list[int] = []
        while len(drawn) < self.count:
            if not self._camera_queue:
                self._camera_queue = self._shuffle(list(self._views_of_camera))
            camera = self._camera_queue.pop()
            # Cameras differ in their number of views, so their rounds end at different times.
            if not self._view_queues[camera]:
                self._view_queues[camera] = self._shuffle(self._views_of_camera[camera])
            drawn.append(self._view_queues[camera].pop())
        return [self.targets[i] for i in drawn]

    def queues(self) -> dict[str, Any]:
        """Describes what is still to come of the present rounds, for a checkpoint.

        Returns:
            Plain values that :meth:`set_queues` takes.
        """
        waiting = {camera: list(views) for camera, views in self._view_queues.items()}
        return {"cameras": list(self._camera_queue), "waiting": waiting}

    def set_queues(self, queues: dict[str, Any]) -> None:
        """Goes on with the rounds that :meth:`queues` described."""
        self._camera_queue = list(queues["cameras"])
        self._view_queues = {camera: list(views) for camera, views in queues["waiting"].items()}

    def _shuffle(self, items: list[Item]) -> list[Item]:
        # Torch's generator and not Python's: its state is part of a checkpoint.
        return [items[i] for i in torch.randperm(len(items), generator=self._generator).tolist()]
