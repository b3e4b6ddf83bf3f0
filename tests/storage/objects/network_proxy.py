"""A proxy between a store and its server that injects faults: errors, lost answers, slow and broken bodies."""

from __future__ import annotations

import http.client
import socket
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any
from urllib.parse import urlsplit

_PIECE_BYTES = 1 << 16


@dataclass(frozen=True)
class Fault:
    """What happens to a request.

    Attributes:
        status: this status is the answer, and the server is not asked.
        text: the body of that answer.
        refuses: the connection is closed at once.
        loses_answer: the server does what was asked, and the connection is closed before its answer.
        upload_bytes: so much of the request's body is passed on before the connection is closed.
        answer_bytes: so much of the answer's body is passed back before the connection is closed.
        delay_s: the request is passed on so much later.
        bytes_per_s: how fast the answer's body is passed back.
    """

    status: int = 0
    text: str = ""
    refuses: bool = False
    loses_answer: bool = False
    upload_bytes: int | None = None
    answer_bytes: int | None = None
    delay_s: float = 0.0
    bytes_per_s: float = 0.0


SOUND = Fault()


class FaultyProxy:
    """Passes requests on to an S3 server, each as the test chooses.

    Args:
        server_url: of the server behind it.

    Attributes:
        choose: called with method and path of every request; chooses what happens to it.
        requests: method and path of all requests so far.
    """

    def __init__(self, server_url: str) -> None:
        self.choose: Callable[[str, str], Fault] = lambda method, path: SOUND
        self.requests: list[tuple[str, str]] = []
        parts = urlsplit(server_url)
        proxy = self

        class Handler(_Handler):
            backend = (str(parts.hostname), int(parts.port or 80))

            def choose(self) -> Fault:
                proxy.requests.append((self.command, self.path))
                return proxy.choose(self.command, self.path)

        self._server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
        self._server.daemon_threads = True
        self.url = f"http://127.0.0.1:{self._server.server_port}"
        threading.Thread(target=self._server.serve_forever, args=(0.05,), daemon=True).start()

    def stop(self) -> None:
        """Closes the port."""
        self._server.shutdown()
        self._server.server_close()

    def fail_once(self, method: str, part: str, fault: Fault, times: int = 1) -> None:
        """Injects a fault into the first requests of a kind.

        Args:
            method: of HTTP.
            part: of the path.
            fault: the fault.
            times: of how many requests.
        """
        left = [None] * times
        lock = threading.Lock()

        def choose(found_method: str, path: str) -> Fault:
            with lock:
                if left and found_method == method and part in path:
                    left.pop()
                    return fault
            return SOUND

        self.choose = choose


class _Handler(BaseHTTPRequestHandler):
    protocol_version = "HTTP/1.1"
    backend = ("", 0)

    def choose(self) -> Fault:
        raise NotImplementedError

    def log_message(self, format: str, *args: Any) -> None:
        """Keeps the tests' output free of requests."""

    def handle_any(self) -> None:
        """Passes one request on, or injects its fault."""
        body = self.rfile.read(int(self.headers.get("Content-Length") or 0))
        fault = self.choose()
        time.sleep(fault.delay_s)
        if fault.refuses:
            self._hang_up()
        elif fault.status:
            text = fault.text.encode()
            self.send_response(fault.status)
            self.send_header("Content-Length", str(len(text)))
            self.end_headers()
            self.wfile.write(text)
        elif fault.upload_bytes is not None:
            self._pass_part(body[: fault.upload_bytes])
            self._hang_up()
        else:
            self._pass_on(body, fault)

    do_GET = do_PUT = do_POST = do_DELETE = do_HEAD = handle_any

    def _pass_on(self, body: bytes, fault: Fault) -> None:
        connection = http.client.HTTPConnection(*self.backend, timeout=60)
        try:
            connection.putrequest(self.command, self.path, skip_host=True, skip_accept_encoding=True)
            for name, value in self.headers.items():
                connection.putheader(name, value)
            connection.endheaders(body)
            answer = connection.getresponse()
            data = answer.read()
        finally:
            connection.close()
        if fault.loses_answer:
            self._hang_up()
            return
        self.send_response(answer.status)
        for name, value in answer.getheaders():
            if name.lower() not in ("content-length", "transfer-encoding", "connection", "date", "server"):
                self.send_header(name, value)
        length = answer.getheader("Content-Length") if self.command == "HEAD" else str(len(data))
        self.send_header("Content-Length", length or "0")
        self.end_headers()
        self._send(data if fault.answer_bytes is None else data[: fault.answer_bytes], fault.bytes_per_s)
        if fault.answer_bytes is not None and fault.answer_bytes < len(data):
            self._hang_up()

    def _pass_part(self, body: bytes) -> None:
        with socket.create_connection(self.backend) as connection:
            lines = [f"{self.command} {self.path} HTTP/1.1", *(f"{k}: {v}" for k, v in self.headers.items())]
            connection.sendall("\r\n".join([*lines, "", ""]).encode() + body)

    def _send(self, data: bytes, bytes_per_s: float) -> None:
        try:
            for start in range(0, len(data), _PIECE_BYTES):
                self.wfile.write(data[start : start + _PIECE_BYTES])
                if bytes_per_s:
                    time.sleep(_PIECE_BYTES / bytes_per_s)
        except OSError:
            # The client gave up.
            self.close_connection = True

    def _hang_up(self) -> None:
        self.close_connection = True
        # At once and not after the answer, as a server that dies does.
        self.connection.shutdown(socket.SHUT_RDWR)
