"""Which scenes show a pose: the background is that of the place, the traffic that of the log's moment."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from genre_tasks.rollout.chunk_layout import ChunkLayout
from genre_tasks.rollout.handover import Handover
from genre_tasks.rollout.traffic import compose_scene, extend_traffic
from genre_tasks.scene_edits.chunk_scene import ChunkScene, SceneSource


@dataclass(frozen=True)
class ShownScene:
    """A scene and how much it counts at a pose.

    Attributes:
        background: number of the chunk that static and distant Gaussians are of.
        chunk_scene: what is rendered, in coordinates of that chunk.
        weight: in [0, 1]; those of a pose add up to 1.
    """

    background: int
    chunk_scene: ChunkScene
    weight: float


class SceneSchedule:
    """Finds the scenes that show a pose.

    A vehicle that brakes stays where an earlier chunk has recorded the street, while actors look best in the chunk that
    has recorded them at that moment. So the background is chosen by place and the actors by moment. Both fade over to
    the next chunk where a hand-over says so.

    Args:
        source: the scenes of a run.
        layout: of its chunks.
        handovers: between chunks that follow each other, in their order.
    """

    def __init__(self, source: SceneSource, layout: ChunkLayout, handovers: Sequence[Handover]) -> None:
        self._source = source
        self._layout = layout
        self._handovers = handovers
        # Scenes put together for the latest pose, by the chunks that they are of.
        self._composed: dict[tuple[int, ...], ChunkScene] = {}

    def find(self, place: float, frame: float) -> tuple[ShownScene, ...]:
        """Finds the scenes of a pose.

        Args:
            place: log frame at which the recorded vehicle was there.
            frame: log frame of the traffic.

        Returns:
            One scene, or up to four within a hand-over; the one that counts most comes first.
        """
        backgrounds = self._weigh([handover.weigh(place) for handover in self._handovers])
        looks = self._weigh([handover.weigh_traffic(frame) for handover in self._handovers])
        # All looks know the actors of the moment, so that none vanishes in a fade.
        moment = tuple(dict.fromkeys((*self._layout.find_traffic(frame), *looks)))
        earlier = self._composed
        self._composed = {}
        shown = []
        for background, background_weight in backgrounds.items():
            for look, look_weight in looks.items():
                key = (background, look, *(number for number in moment if number != look))
                if key == (background, background):
                    scene = self._source.load(background)
                else:
                    # Kept from pose to pose, because it copies Gaussians.
                    scene = earlier[key] if key in earlier else self._compose(key)
                    self._composed[key] = scene
                shown.append(ShownScene(background, scene, background_weight * look_weight))
        return tuple(sorted(shown, key=lambda scene: -scene.weight))

    def _weigh(self, weights: Sequence[float]) -> dict[int, float]:
        """Weights by chunk, without those of 0, from the weight of each hand-over's later chunk."""
        found = {self._source.chunk_numbers[0]: 1.0}
        for handover, weight in zip(self._handovers, weights, strict=True):
            if weight > 0:
                found = {handover.before: 1 - weight, handover.after: weight}
        return {number: weight for number, weight in found.items() if weight > 0}

    def _compose(self, key: tuple[int, ...]) -> ChunkScene:
        background, look, *others = key
        traffic = self._source.load(look)
        for other in others:
            traffic = extend_traffic(traffic, self._source.load(other))
        return traffic if background == look else compose_scene(self._source.load(background), traffic)
