"""Starts the sensor service for the runs that ``genre serve`` has read."""

from __future__ import annotations

from flows.simulators.alpasim.local_frame import read_local_frame
from flows.simulators.alpasim.sensor_service import SensorService
from flows.simulators.alpasim.served_scene import ServedScene
from flows.simulators.alpasim.server import SensorServer
from flows.simulators.service import MAX_QUEUE, RunningService, ServiceRequest


def start_alpasim(request: ServiceRequest) -> RunningService:
    """Starts the service that AlpaSim and NuRec ask for images; a ``StartService``.

    Args:
        request: scenes and address.

    Returns:
        The service, which answers calls already.

    Raises:
        ConfigError: the address cannot be listened at.
        InputError: an artifact of a run is gone.
    """
    scenes = {
        name: ServedScene(renderer, read_local_frame(renderer.scenes)) for name, renderer in request.renderers.items()
    }
    # Each renderer has a queue: as many calls may wait as all of them take, up to what one process bears.
    waiting = sum(renderer.limits.max_waiting for renderer in request.renderers.values())
    return SensorServer(
        SensorService(scenes, request.metrics),
        host=request.host,
        port=request.port,
        max_waiting=min(waiting, MAX_QUEUE),
        metrics=request.metrics,
    )
