"""Which views supervise an iteration: cameras in turn, each camera's views in shuffled order."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch

from genre_tasks.losses.targets import Target


class ViewSampler:
    """Draws ``count`` of the given views for each iteration.

    Cameras come in shuffled rounds, so that a full round sees every direction once; a camera's views come in shuffled
    order without repetition until all were drawn. ``count`` at or above the number of views: all of them, in order.
    """

    def __init__(self, targets: Sequence[Target], count: int, generator: torch.Generator) -> None:
        self.targets = tuple(targets)
        self.count = min(count, len(self.targets))
        self._generator = generator
        self._by_camera: dict[str, list[int]] = {}
        for i, target in enumerate(self.targets):
            self._by_camera.setdefault(target.camera, []).append(i)
        self._cameras: list[str] = []
        self._waiting: dict[str, list[int]] = {camera: [] for camera in self._by_camera}

    def draw(self) -> list[Target]:
        """The next iteration's views; none where there are none."""
        if self.count == len(self.targets):
            return list(self.targets)
        drawn: list[int] = []
        while len(drawn) < self.count:
            if not self._cameras:
                self._cameras = self._shuffled(list(self._by_camera))
            camera = self._cameras.pop()
            if not self._waiting[camera]:
                self._waiting[camera] = self._shuffled(self._by_camera[camera])
            drawn.append(self._waiting[camera].pop())
        return [self.targets[i] for i in drawn]

    def queues(self) -> dict[str, Any]:
        """What is still to come of the present rounds, as plain values for a checkpoint."""
        return {"cameras": list(self._cameras), "waiting": {k: list(v) for k, v in self._waiting.items()}}

    def set_queues(self, queues: dict[str, Any]) -> None:
        """The inverse of :meth:`queues`."""
        self._cameras = list(queues["cameras"])
        self._waiting = {k: list(v) for k, v in queues["waiting"].items()}

    def _shuffled(self, items: list) -> list:
        return [items[i] for i in torch.randperm(len(items), generator=self._generator).tolist()]
