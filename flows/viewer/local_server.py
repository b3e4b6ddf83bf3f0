"""A viser server that stays on this machine: it prints nothing and opens no tunnel to the internet."""

from __future__ import annotations

import contextlib
import errno
import io
import socket

import viser

from flows.viewer.viewed_chunks import ViewedChunk
from genre_tasks.errors import ConfigError

PORTS_TRIED = 50
"""From a port that is taken the next ones are tried."""

_FOV_RAD = 1.1
_BEHIND_M = 5.5
_ABOVE_M = 3.5
_AHEAD_M = 20.0
_NEAR_M = 0.1
_FAR_M = 5000.0


class LocalServer(viser.ViserServer):
    """A server whose clients cannot ask it to share the scene with the world."""

    def request_share_url(self, verbose: bool = True) -> str | None:
        """Refuses: a shared address would make the scene public by one click in a browser.

        Args:
            verbose: as in viser.
        """
        return None


def find_free_port(host: str, port: int) -> int:
    """Finds a port that a server can listen at.

    Args:
        host: address to bind.
        port: the first one to try; 0: any.

    Returns:
        The port, or 0 for any.

    Raises:
        ConfigError: the address is not this machine's, or no port is free.
    """
    # viser would wait for ever where it cannot bind any port.
    for number in range(port, min(port + PORTS_TRIED, 65536)):
        try:
            family = socket.getaddrinfo(host, number, type=socket.SOCK_STREAM)[0][0]
            with socket.socket(family, socket.SOCK_STREAM) as probe:
                probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
                probe.bind((host, number))
            return number
        except OSError as error:
            if error.errno == errno.EADDRINUSE:
                continue
            problem = f"the viewer cannot listen at {host}, port {number} ({error.strerror})"
            raise ConfigError(problem, remedy="Give another --host or --port.") from error
    raise ConfigError(f"no port from {port} on is free", remedy="Give another --port, or 0 for any.")


def start_server(host: str, port: int, label: str) -> LocalServer:
    """Starts a server.

    Args:
        host: address to bind.
        port: number of the port, where a taken one leads to the next; 0: any free one.
        label: heading of the panel.

    Returns:
        The server, which runs in threads until it is stopped.

    Raises:
        ConfigError: the address is not this machine's, or no port is free.
    """
    free = find_free_port(host, port)
    # viser prints a table with its address on standard output, where the command's own sentences go.
    with contextlib.redirect_stdout(io.StringIO()):
        server = LocalServer(host=host, port=free, label=label, verbose=False)
    server.gui.configure_theme(show_logo=False, show_share_button=False, control_width="medium")
    return server


def stop_server(server: viser.ViserServer) -> None:
    """Stops a server without a word.

    Args:
        server: to stop; its clients lose their connection.
    """
    with contextlib.redirect_stdout(io.StringIO()):
        server.stop()


def aim_first_view(server: viser.ViserServer, viewed: ViewedChunk) -> None:
    """Places the camera of new clients behind and above the vehicle, looking along the path.

    Args:
        server: whose clients.
        viewed: the chunk.
    """
    pose = viewed.chunk_SE3_ego[0]
    place = pose[:3, 3]
    forward = pose[:3, 0]
    camera = server.initial_camera
    camera.position = place - _BEHIND_M * forward + [0.0, 0.0, _ABOVE_M]
    camera.look_at = place + _AHEAD_M * forward
    camera.up = (0.0, 0.0, 1.0)
    camera.fov = _FOV_RAD
    camera.near = _NEAR_M
    camera.far = _FAR_M
