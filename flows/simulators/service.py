"""What every protocol's service is: started with scenes and a place to listen at, and closed again."""

from __future__ import annotations

import ipaddress
import socket
from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Protocol

from genre_tasks.errors import ConfigError

if TYPE_CHECKING:
    from flows.simulators.scene_renderer import SceneRenderer
    from flows.simulators.service_metrics import ServiceMetrics


MAX_QUEUE = 256
"""At most so many requests may wait: each takes a thread and a connection, and a process may open some 1000 files."""


@dataclass(frozen=True)
class ServiceRequest:
    """What a service is started with.

    Attributes:
        renderers: of one or more runs, by the scene's name.
        host: address to listen at.
        port: 0: any free one.
        metrics: where requests are counted.
    """

    renderers: Mapping[str, SceneRenderer]
    host: str
    port: int
    metrics: ServiceMetrics


class RunningService(Protocol):
    """A service that answers clients in threads of its own."""

    @property
    def address(self) -> str:
        """Where it listens, such as ``http://127.0.0.1:8000``."""
        ...

    def wait(self) -> None:
        """Waits until the service ends; a signal ends the wait."""
        ...

    def close(self) -> None:
        """Ends the service: it answers what it has begun with, for a few seconds at most."""
        ...


class StartService(Protocol):
    """Starts a service of a protocol."""

    def __call__(self, request: ServiceRequest) -> RunningService:
        """Starts it.

        Args:
            request: scenes and address.

        Raises:
            ConfigError: the address cannot be listened at, or the protocol does not take so many scenes.
        """
        ...


def bind_socket(host: str, port: int) -> socket.socket:
    """Takes a port, so that an occupied one is an error before any client comes.

    Args:
        host: address to listen at.
        port: 0: any free one.

    Returns:
        A listening socket.

    Raises:
        ConfigError: the address is no one's, or the port is taken.

    >>> with bind_socket("127.0.0.1", 0) as listening:
    ...     listening.getsockname()[0]
    '127.0.0.1'
    """
    try:
        family, _, _, _, address = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0]
        listening = socket.create_server(address[:2], family=family)
    except (OSError, UnicodeError) as error:
        raise ConfigError(
            f"cannot listen at {host}, port {port} ({error})", remedy="Choose another --host or --port."
        ) from error
    # Connections inherit it: otherwise the end of an answer waits 40 ms for the client's acknowledgement.
    listening.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    return listening


def is_loopback(host: str) -> bool:
    """Tells whether an address is reached from this machine alone.

    Args:
        host: name or address.

    >>> is_loopback("127.0.0.1"), is_loopback("0.0.0.0")
    (True, False)
    """
    if host == "localhost":
        return True
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False
