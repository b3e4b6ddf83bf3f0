"""A run as the sensor service knows it."""

from __future__ import annotations

from flows.simulators.alpasim.local_frame import LocalFrame
from flows.simulators.scene_renderer import SceneRenderer


class ServedScene:
    """A run, its renderer and its coordinates on the wire.

    Args:
        renderer: of the run.
        frame: that poses on the wire are stated in; the bundle has the same.

    Attributes:
        renderer: of the run.
        frame: that poses on the wire are stated in.
        track_ids: of all moving actors.
        masks: [H, W] true on the recording vehicle itself, by camera.
    """

    def __init__(self, renderer: SceneRenderer, frame: LocalFrame) -> None:
        self.renderer = renderer
        self.frame = frame
        self.track_ids = frozenset(actor.track_id for actor in renderer.actors())
        masks = {name: renderer.ego_mask(name) for name in renderer.cameras}
        self.masks = {name: mask for name, mask in masks.items() if mask is not None}
