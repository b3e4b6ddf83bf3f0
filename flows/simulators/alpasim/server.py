"""The gRPC server of the sensor service: bytes in, bytes out, and every error as a status code."""

from __future__ import annotations

import logging
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from contextlib import nullcontext
from typing import TYPE_CHECKING, Any

import grpc
from google.protobuf.message import DecodeError, Message

from flows.simulators.alpasim import common_pb2, sensorsim_pb2
from flows.simulators.render_queue import render_while
from flows.simulators.service_metrics import ServiceMetrics, SilentMetrics
from genre_tasks.errors import ConfigError, GenreError, InputError, NonFiniteError, ResourceError

if TYPE_CHECKING:
    from flows.simulators.alpasim.sensor_service import SensorService

SERVICE = "nre.grpc.protos.sensorsim.SensorsimService"

MAX_REQUEST_BYTES = 4 << 20
"""A batch of 32 images with 1000 objects each has 3 MB."""

LARGE_REQUEST_BYTES = 256 << 10
"""A message takes up to 30 times its size in memory, so larger requests are answered one at a time."""

MAX_ANSWER_BYTES = 64 << 20
"""What AlpaSim's client takes; a batch of PNG images is far smaller."""

REQUEST_TYPES: dict[str, type[Message]] = {
    "render_rgb": sensorsim_pb2.RGBRenderRequest,
    "render_lidar": sensorsim_pb2.LidarRenderRequest,
    "render_aggregated": sensorsim_pb2.AggregatedRenderRequest,
    "batch_render_rgb": sensorsim_pb2.BatchRGBRenderRequest,
    "get_version": common_pb2.Empty,
    "get_available_scenes": common_pb2.Empty,
    "get_loaded_scenes": common_pb2.Empty,
    "get_available_cameras": sensorsim_pb2.AvailableCamerasRequest,
    "get_available_trajectories": sensorsim_pb2.AvailableTrajectoriesRequest,
    "get_available_ego_masks": common_pb2.Empty,
}
"""What each method of the service is called with."""

_STATUS_NAMES: tuple[tuple[type[Exception], str], ...] = (
    (DecodeError, "INVALID_ARGUMENT"),
    (InputError, "INVALID_ARGUMENT"),
    (ConfigError, "UNIMPLEMENTED"),
    (ResourceError, "RESOURCE_EXHAUSTED"),
    (NonFiniteError, "OUT_OF_RANGE"),
    (GenreError, "FAILED_PRECONDITION"),
    (Exception, "INTERNAL"),
)

SILENT = SilentMetrics()

_log = logging.getLogger(__name__)


def find_status_name(error: Exception) -> str:
    """Finds the gRPC status code of an error.

    Args:
        error: that answering a call raised.

    Returns:
        The code's name.

    >>> find_status_name(ConfigError("no such lens", remedy="Send another."))
    'UNIMPLEMENTED'
    """
    return next(name for kind, name in _STATUS_NAMES if isinstance(error, kind))


class SensorServer:
    """Serves a scene on a port, until :meth:`close`; a ``RunningService``.

    Args:
        service: what answers the calls.
        host: an address of this machine; the default is reached from this machine alone.
        port: to listen on; 0: any free one.
        max_waiting: calls that may wait while another one is rendered.
        metrics: where calls are counted.

    Raises:
        ConfigError: the port is taken, or the address is no one's.

    Example::

        with SensorServer(service) as server:
            print(server.address)
            server.wait()
    """

    def __init__(
        self,
        service: SensorService,
        host: str = "127.0.0.1",
        port: int = 0,
        max_waiting: int = 16,
        metrics: ServiceMetrics = SILENT,
    ) -> None:
        self._service = service
        self._metrics = metrics
        self._large_requests = threading.Lock()
        # Calls that only ask for facts are answered while all others wait for the renderer.
        workers = max_waiting + 4
        self._pool = ThreadPoolExecutor(workers, thread_name_prefix="sensorsim")
        self._server = grpc.server(
            self._pool,
            options=(
                ("grpc.max_receive_message_length", MAX_REQUEST_BYTES),
                ("grpc.max_send_message_length", MAX_ANSWER_BYTES),
                # Two servers on one port would each get some of the calls.
                ("grpc.so_reuseport", 0),
            ),
            maximum_concurrent_rpcs=2 * workers,
        )
        handlers = {name: self._make_handler(name) for name in REQUEST_TYPES}
        generic = grpc.method_handlers_generic_handler(SERVICE, handlers)
        self._server.add_generic_rpc_handlers((generic,))
        # An address of IPv6 has colons of its own.
        self._host = f"[{host}]" if ":" in host else host
        try:
            self._port = self._server.add_insecure_port(f"{self._host}:{port}")
        except RuntimeError as error:
            raise ConfigError(f"cannot listen on {host}:{port}", remedy="Choose another --port or --host.") from error
        self._server.start()

    @property
    def address(self) -> str:
        """``host:port`` that clients connect to."""
        return f"{self._host}:{self._port}"

    def wait(self, timeout_s: float | None = None) -> None:
        """Waits until the server has ended; a signal ends the wait.

        Args:
            timeout_s: at most so long; ``None``: without end.
        """
        self._server.wait_for_termination(timeout_s)

    def close(self, grace_s: float = 5.0) -> None:
        """Ends the server: new calls are refused at once, those under way get time to be answered.

        Args:
            grace_s: how much.
        """
        self._server.stop(grace_s).wait()
        self._pool.shutdown(wait=True, cancel_futures=True)

    def __enter__(self) -> SensorServer:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _make_handler(self, method: str) -> Any:
        # Without deserializer: a request that cannot be read gets a status that says so, instead of INTERNAL.
        return grpc.unary_unary_rpc_method_handler(lambda payload, context: self._answer(method, payload, context))

    def _answer(self, method: str, payload: bytes, context: grpc.ServicerContext) -> bytes:
        start = time.perf_counter()
        name = "OK"
        answer = b""
        try:
            large = self._large_requests if len(payload) > LARGE_REQUEST_BYTES else nullcontext()
            with large, render_while(context.is_active):
                answer = answer_call(self._service, method, payload)
        except Exception as error:
            name = find_status_name(error)
            details = str(error)
            if name == "INTERNAL":
                # A fault of the program: the client learns that there was one, the log learns where.
                _log.exception("%s failed", method)
                details = "the service failed; see its log"
            context.set_code(grpc.StatusCode[name])
            context.set_details(details)
        self._metrics.count_request(method, name, time.perf_counter() - start)
        return answer


def answer_call(service: SensorService, method: str, payload: bytes) -> bytes:
    """Answers one call.

    Args:
        service: that has the method.
        method: a key of ``REQUEST_TYPES``.
        payload: the request as it came over the wire.

    Returns:
        The answer's bytes.

    Raises:
        DecodeError: the payload is no message.
        GenreError: the service refuses the request.
    """
    request = REQUEST_TYPES[method].FromString(payload)
    answer: Message = getattr(service, method)(request)
    return answer.SerializeToString()
