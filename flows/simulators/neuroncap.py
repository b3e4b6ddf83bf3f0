"""NeuroNCAP's renderer protocol over HTTP: alive, start_time, get_actors, update_actors and render_image."""

from __future__ import annotations

import threading
import time
from collections.abc import Awaitable, Callable
from dataclasses import replace
from typing import Literal, TypeVar, TypeVarTuple

import numpy as np
from anyio import CapacityLimiter, from_thread, to_thread
from starlette.applications import Starlette
from starlette.requests import ClientDisconnect, Request
from starlette.responses import JSONResponse, Response
from starlette.routing import Route

from flows.simulators.encoded_images import encode_image
from flows.simulators.http_thread import HttpThread
from flows.simulators.image_request import ImageRequest
from flows.simulators.neuroncap_messages import (
    MICROSECONDS,
    ImageMessage,
    Trajectory,
    describe_recorded,
    find_unchanged,
    parse_image,
    parse_trajectories,
    write_trajectories,
)
from flows.simulators.render_queue import render_while
from flows.simulators.scene_renderer import SceneRenderer
from flows.simulators.service import RunningService, ServiceRequest
from flows.simulators.service_metrics import ServiceMetrics
from genre_tasks.errors import ConfigError, GenreError, InputError, ResourceError

MAX_BODY_BYTES = 64 * 2**20
"""Of one request: a thousand actors over twenty seconds take less, at some 300 bytes a pose."""

# Beside those that wait and render: requests that are read, refused or answered without a render.
_FURTHER_THREADS = 24
_REFUSED_FORMAT = 406
_TOO_LARGE = 413
_UNFIT = 422
_FAULT = 500
_BUSY = 503

T = TypeVar("T")
Arguments = TypeVarTuple("Arguments")
Handler = Callable[[Request], Awaitable[Response]]


class _BodyTooLargeError(Exception):
    """A request has more bytes than are read."""


class ActorState:
    """The actors of a service: the recorded ones, until a client sets others.

    Args:
        renderer: of the run.
    """

    def __init__(self, renderer: SceneRenderer) -> None:
        self._renderer = renderer
        self._lock = threading.Lock()
        self._trajectories = describe_recorded(renderer.actors(), renderer.frame_s)
        self._recorded = self._trajectories
        self._placed = self._trajectories
        self._unchanged = tuple(trajectory.track_id for trajectory in self._recorded)

    @property
    def trajectories(self) -> tuple[Trajectory, ...]:
        """Those that images show at present, by the ids or names that the client has sent."""
        with self._lock:
            return self._trajectories

    def replace_all(self, trajectories: tuple[Trajectory, ...]) -> None:
        """Sets all actors; one that is not among them is absent from now on.

        Args:
            trajectories: of a client.

        Raises:
            InputError: an actor is not known, or is there twice.
        """
        track_ids = self._renderer.find_actors([trajectory.track_id for trajectory in trajectories])
        # By the log's ids, as the recorded ones are: the readable name of an actor may be the id of another.
        placed = tuple(
            replace(trajectory, track_id=track_id) for trajectory, track_id in zip(trajectories, track_ids, strict=True)
        )
        with self._lock:
            self._trajectories = trajectories
            self._placed = placed
            # Recorded actors stand where they were at each camera's own moment, which the messages do not carry.
            self._unchanged = find_unchanged(placed, self._recorded)

    def request_image(self, message: ImageMessage) -> ImageRequest:
        """Turns a message into a request of the renderer.

        Args:
            message: of a client.

        Raises:
            InputError: the run has no such camera.
        """
        camera = self._renderer.select_cameras([message.camera_name])[message.camera_name]
        pose = np.array(message.pose, np.float64)
        time_s = message.timestamp / MICROSECONDS
        with self._lock:
            trajectories = self._placed
            unchanged = self._unchanged
        is_recorded = len(unchanged) == len(trajectories) == len(self._recorded)
        placed = [t.pose_at(message.timestamp) for t in trajectories if t.track_id not in unchanged]
        # One pose and one time: this protocol's cameras have a global shutter.
        return ImageRequest(
            lens=camera.lens,
            start_world_SE3_camera=pose,
            end_world_SE3_camera=pose,
            start_s=time_s,
            end_s=time_s,
            actors=None if is_recorded else tuple(actor for actor in placed if actor is not None),
            recorded_actors=() if is_recorded else unchanged,
            camera=message.camera_name,
        )


class NeuroncapApp:
    """Answers the protocol's five requests.

    Args:
        renderer: of the run.
        metrics: where requests are counted.
    """

    def __init__(self, renderer: SceneRenderer, metrics: ServiceMetrics) -> None:
        self._renderer = renderer
        self._metrics = metrics
        self._state = ActorState(renderer)
        # The usual forty threads would all wait in a longer queue, and its end would hear nothing.
        self._threads = CapacityLimiter(renderer.limits.max_waiting + _FURTHER_THREADS)

    def build(self) -> Starlette:
        """Makes the application that a server runs."""
        return Starlette(
            routes=[
                self._route("/alive", "GET", self._alive),
                self._route("/start_time", "GET", self._start_time),
                self._route("/get_actors", "GET", self._get_actors),
                self._route("/update_actors", "POST", self._update_actors),
                self._route("/render_image", "POST", self._render_image),
            ]
        )

    def _route(self, path: str, method: str, handler: Handler) -> Route:
        async def answer(request: Request) -> Response:
            started = time.perf_counter()
            response = await _guard(handler, request)
            self._metrics.count_request(path[1:], str(response.status_code), time.perf_counter() - started)
            return response

        return Route(path, answer, methods=[method])

    async def _alive(self, request: Request) -> Response:
        return JSONResponse(True)

    async def _start_time(self, request: Request) -> Response:
        return JSONResponse(round(self._renderer.time_range_s[0] * MICROSECONDS))

    async def _get_actors(self, request: Request) -> Response:
        return JSONResponse(await self._run(write_trajectories, self._state.trajectories))

    async def _update_actors(self, request: Request) -> Response:
        body = await _read_body(request)

        def update() -> None:
            self._state.replace_all(parse_trajectories(body))

        await self._run(update)
        return JSONResponse(None)

    async def _render_image(self, request: Request) -> Response:
        body = await _read_body(request)

        def is_wanted() -> bool:
            # Called in a thread, while the event loop answers others.
            return not from_thread.run(request.is_disconnected)

        return await self._run(self._answer_image, body, is_wanted)

    async def _run(self, function: Callable[[*Arguments], T], *arguments: *Arguments) -> T:
        """Calls a function in a thread, so that other requests are answered meanwhile."""
        return await to_thread.run_sync(function, *arguments, limiter=self._threads)

    def _answer_image(self, body: bytes, is_wanted: Callable[[], bool]) -> Response:
        message = parse_image(body)
        if message.image_format == "raw":
            detail = "the format raw, this protocol's default, is a pickle, which could run code: ask for png or jpg"
            return _refuse(_REFUSED_FORMAT, detail)
        with render_while(is_wanted):
            pixels = self._renderer.render(self._state.request_image(message))
        self._metrics.count_images(1)
        image_format: Literal["png", "jpeg"] = "png" if message.image_format == "png" else "jpeg"
        return Response(encode_image(pixels, image_format), media_type=f"image/{image_format}")


def start_neuroncap(request: ServiceRequest) -> RunningService:
    """Starts the service; a ``StartService``.

    Args:
        request: with the renderer of one run.

    Raises:
        ConfigError: there are several runs, or the address cannot be listened at.
    """
    if len(request.renderers) != 1:
        raise ConfigError(
            f"the protocol neuroncap has no names of scenes, and {len(request.renderers)} runs are to be served",
            remedy="Name one run, and start a service for each at a --port of its own.",
        )
    (renderer,) = request.renderers.values()
    app = NeuroncapApp(renderer, request.metrics).build()
    return HttpThread(app, request.host, request.port, renderer.limits.max_waiting)


async def _guard(handler: Handler, request: Request) -> Response:
    """Answers a request, and every mistake in it with a status and a sentence."""
    try:
        return await handler(request)
    except _BodyTooLargeError:
        return _refuse(_TOO_LARGE, f"a request has at most {MAX_BODY_BYTES} bytes")
    except ClientDisconnect:
        return _refuse(_UNFIT, "the client went away")
    except InputError as error:
        return _refuse(_UNFIT, str(error))
    except ResourceError as error:
        response = _refuse(_BUSY, str(error))
        response.headers["Retry-After"] = "1"
        return response
    except GenreError as error:
        return _refuse(_FAULT, str(error))


def _refuse(status: int, detail: str) -> Response:
    return JSONResponse({"detail": detail}, status_code=status)


async def _read_body(request: Request) -> bytes:
    """The body of a request, read no further than it may be long."""
    parts = bytearray()
    async for part in request.stream():
        parts += part
        if len(parts) > MAX_BODY_BYTES:
            raise _BodyTooLargeError
    return bytes(parts)
