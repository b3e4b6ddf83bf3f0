"""A small HTTP proxy between a client and its store, which can refuse, fail, be slow, or cut uploads off."""

from __future__ import annotations

import asyncio
import socket
import threading
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from typing import Literal

Mode = Literal["ok", "503", "slow", "refuse", "truncate"]
HOST = "127.0.0.1"
_HEAD_BYTES = 64 << 10
_BLOCK_BYTES = 64 << 10
_UNAVAILABLE = (
    b"HTTP/1.1 503 Service Unavailable\r\nContent-Type: application/xml\r\nContent-Length: %d\r\n"
    b"Connection: close\r\n\r\n%s"
)
_SLOW_DOWN = b"<Error><Code>SlowDown</Code><Message>Please reduce your request rate.</Message></Error>"


class FaultyProxy:
    """Forwards requests to one server, one connection a request, and fails as its mode says.

    =========== ====================================================================================
    ok          forwards
    503         reads the request, and answers 503 SlowDown
    slow        waits ``delay_s`` before it forwards
    refuse      does not listen: a connection is refused, and open ones are reset
    truncate    forwards half of the body of the next upload, then drops both connections
    =========== ====================================================================================

    Args:
        port: of the server on the loopback.
        delay_s: of the mode ``slow``.
    """

    def __init__(self, port: int, delay_s: float = 3.0) -> None:
        self.upstream = port
        self.delay_s = delay_s
        self.port = 0
        self.mode: Mode = "ok"
        self.hits: Counter[str] = Counter()
        """Requests that came in every mode; for ``truncate`` uploads that were cut off."""
        self._loop = asyncio.new_event_loop()
        self._server: asyncio.Server | None = None
        self._open: set[asyncio.StreamWriter] = set()

    @property
    def url(self) -> str:
        """Where clients reach it."""
        return f"http://{HOST}:{self.port}"

    def set_mode(self, mode: Mode) -> None:
        """Changes the mode; returns once it is in force."""
        asyncio.run_coroutine_threadsafe(self._change(mode), self._loop).result(30)

    async def _change(self, mode: Mode) -> None:
        self.mode = mode
        if mode == "refuse":
            await self._stop_listening()
        elif self._server is None:
            await self._listen()

    async def _listen(self) -> None:
        # The same port again, as clients know it.
        self._server = await asyncio.start_server(self._serve, HOST, self.port, limit=_HEAD_BYTES)
        self.port = self._server.sockets[0].getsockname()[1]

    async def _stop_listening(self) -> None:
        if self._server is None:
            return
        self._server.close()
        self._server = None
        for writer in list(self._open):
            _reset(writer)

    async def _serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        self._open.add(writer)
        try:
            await self._answer(reader, writer)
        except (OSError, asyncio.IncompleteReadError):
            _reset(writer)
        finally:
            self._open.discard(writer)
            with suppress(OSError):
                writer.close()

    async def _answer(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        head = await reader.readuntil(b"\r\n\r\n")
        mode = self.mode
        length = _read_length(head)
        body = await reader.readexactly(length)
        if mode == "truncate" and length > 1:
            # One upload for each time the mode is set.
            self.mode = "ok"
            self.hits[mode] += 1
            await self._forward(head, body[: length // 2], None)
            _reset(writer)
            return
        self.hits["ok" if mode == "truncate" else mode] += 1
        if mode == "503":
            writer.write(_UNAVAILABLE % (len(_SLOW_DOWN), _SLOW_DOWN))
            await writer.drain()
            return
        if mode == "slow":
            await asyncio.sleep(self.delay_s)
        await self._forward(head, body, writer)

    async def _forward(self, head: bytes, body: bytes, client: asyncio.StreamWriter | None) -> None:
        reader, writer = await asyncio.open_connection(HOST, self.upstream)
        try:
            writer.write(_close_after(head) + body)
            await writer.drain()
            if client is None:
                return
            while block := await reader.read(_BLOCK_BYTES):
                client.write(block)
                await client.drain()
        finally:
            _reset(writer) if client is None else writer.close()

    @contextmanager
    def run(self) -> Iterator[FaultyProxy]:
        """Listens in a thread while the block runs."""
        thread = threading.Thread(target=self._loop.run_forever, daemon=True)
        thread.start()
        try:
            self.set_mode("ok")
            yield self
        finally:
            self.set_mode("refuse")
            self._loop.call_soon_threadsafe(self._loop.stop)
            thread.join(10)


def _reset(writer: asyncio.StreamWriter) -> None:
    # Aborted with SO_LINGER 0, a connection ends with RST and not as if all were said.
    connection = writer.get_extra_info("socket")
    if connection is not None:
        with suppress(OSError):
            connection.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, b"\1\0\0\0\0\0\0\0")
    writer.transport.abort()


def _read_length(head: bytes) -> int:
    for line in head.split(b"\r\n"):
        name, _, value = line.partition(b":")
        if name.strip().lower() == b"content-length":
            return int(value)
    return 0


def _close_after(head: bytes) -> bytes:
    """The head of a request that asks the server to close the connection after its answer."""
    lines = [line for line in head.split(b"\r\n") if not line.lower().startswith(b"connection:")]
    return b"\r\n".join([lines[0], b"Connection: close", *lines[1:]])
