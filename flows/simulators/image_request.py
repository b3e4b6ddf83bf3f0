"""What a simulator asks a renderer for, and what it learns about a scene: plain values that every protocol shares."""

from __future__ import annotations

from dataclasses import dataclass

from genre_tasks.logs.types import Float64, Lens


@dataclass(frozen=True)
class ActorPose:
    """Where a simulator wants an actor during one image.

    Attributes:
        track_id: the log's id of the actor, or its readable name such as ``car-3``.
        start_world_SE3_box: [4, 4] at the start of the image's readout.
        end_world_SE3_box: [4, 4] at its end.
    """

    track_id: str
    start_world_SE3_box: Float64
    end_world_SE3_box: Float64


@dataclass(frozen=True)
class ImageRequest:
    """One image that a simulator wants.

    Attributes:
        lens: its size is that of the image.
        start_world_SE3_camera: [4, 4] at the start of the readout; axes x right, y down, z forward.
        end_world_SE3_camera: [4, 4] at its end; equal to the start for a camera that rests, or a global shutter.
        start_s: when the readout starts, seconds in the log's absolute time.
        end_s: when it ends; equal to ``start_s`` for a global shutter, whose poses are then the middle of both.
        actors: ``None``: the recorded actors of that moment; else exactly these, and no other actor is there.
        camera: name of the run's camera that this image stands for. Cameras of a rig fire at moments of their own, so
            it decides which log frame a time belongs to; ``None``: the mean over all cameras.
        recorded_actors: track ids of actors that are, next to ``actors``, where they were recorded. Only for images
            whose rows are read all at once.
    """

    lens: Lens
    start_world_SE3_camera: Float64
    end_world_SE3_camera: Float64
    start_s: float
    end_s: float
    actors: tuple[ActorPose, ...] | None = None
    camera: str | None = None
    recorded_actors: tuple[str, ...] = ()


@dataclass(frozen=True)
class CameraDescription:
    """A camera of the run's rig.

    Attributes:
        name: as the log has it.
        lens: at the working resolution of the run.
        rig_SE3_camera: [4, 4] where it sits on the ego vehicle, whose pose :meth:`SceneRenderer.ego_trajectory` gives.
        readout_s: rolling shutter, seconds from the first row to the last; 0: a global shutter.
    """

    name: str
    lens: Lens
    rig_SE3_camera: Float64
    readout_s: float


@dataclass(frozen=True)
class ActorDescription:
    """A moving actor of the run.

    Attributes:
        track_id: as the log has it.
        name: readable, such as ``car-3``.
        label: its class, in the log's words.
        size_m: length, width and height of its box.
        times_s: [F] seconds in the log's absolute time, rising.
        world_SE3_box: [F, 4, 4] at these times; the origin is the centre, x forward, y left, z up.
    """

    track_id: str
    name: str
    label: str
    size_m: tuple[float, float, float]
    times_s: Float64
    world_SE3_box: Float64


@dataclass(frozen=True)
class RenderLimits:
    """What one client may ask for.

    Attributes:
        max_width_px: of an image.
        max_height_px: of an image.
        max_batch: images of one call.
        max_waiting: calls that wait while another one is rendered.
    """

    max_width_px: int = 1920
    max_height_px: int = 1280
    max_batch: int = 32
    max_waiting: int = 16
