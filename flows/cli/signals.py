"""SIGINT, SIGTERM and SIGHUP end a command in order: what is finished is kept, and no process stays behind."""

from __future__ import annotations

import os
import signal
import socket
import sys
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from types import CodeType, FrameType
from typing import TypeVar

# A user who stops a command waits for it; what takes longer than this is not worth the wait.
_MAX_SECONDS_TO_END = 6.0
_SIGNALS = ("SIGINT", "SIGTERM", "SIGHUP")
# A shell reports a command that a signal ended by this number plus that of the signal.
_EXIT_STATUS_BASE = 128
# How often a signal waits for a function that must not be broken off, and how long each time: half a second at most,
# since a write may wait for ever for a reader.
_MOST_DELAYS = 50
_DELAY_S = 0.01

_delaying_code: set[CodeType] = set()
_delays = 0

Function = TypeVar("Function", bound=Callable[..., object])


# No KeyboardInterrupt, which the parser of commands would turn into a status of its own.
class Interrupted(BaseException):
    """A signal asks the command to end.

    Args:
        number: the signal's number.

    >>> Interrupted(signal.SIGTERM).exit_status
    143
    """

    def __init__(self, number: int) -> None:
        super().__init__()
        self.number = number

    @property
    def exit_status(self) -> int:
        """What a shell would report: 130 for Ctrl-C, 143 for SIGTERM, 129 for SIGHUP."""
        return _EXIT_STATUS_BASE + self.number


def delay_signals(function: Function) -> Function:
    """Lets a function finish before a signal ends the command, as a decorator.

    The signal comes again a moment later, and again for half a second; then it ends the command wherever it is.

    Args:
        function: what is short, and leaves something half-done where an exception breaks it off.

    Returns:
        The same function.
    """
    _delaying_code.add(function.__code__)  # type: ignore[attr-defined]
    return function


def end_on_signals() -> None:
    """Makes the three signals raise ``Interrupted`` in the main thread, and end the process soon in any case.

    A signal that the process was started to ignore stays ignored, as ``nohup`` and background jobs of a shell ask.
    A second signal ends the process at once.
    """
    is_main_thread = threading.current_thread() is threading.main_thread()
    if not is_main_thread or signal.getsignal(signal.SIGTERM) is _interrupt:
        return
    for name in _SIGNALS:
        # SIGHUP does not exist everywhere.
        number = getattr(signal, name, None)
        if number is not None and signal.getsignal(number) != signal.SIG_IGN:
            signal.signal(number, _interrupt)
    _end_soon_after_signals()


def exit_process(status: int) -> None:
    """Ends the process with an exit status; after a signal at once, without waiting for any thread.

    Args:
        status: of the command.

    Raises:
        SystemExit: unless a signal ended the command.
    """
    numbers = [getattr(signal, name) for name in _SIGNALS if hasattr(signal, name)]
    if status - _EXIT_STATUS_BASE in numbers:
        # Prefect's API may still be starting in its thread, which Python cannot clean up after.
        with suppress(OSError, ValueError):
            sys.stdout.flush()
            sys.stderr.flush()
        os._exit(status)
    raise SystemExit(status)


def _end_soon_after_signals() -> None:
    """Ends the process some seconds after a signal, whatever becomes of it.

    Prefect puts a handler of its own in the place of ours while a flow runs, and an exception that a handler raises may
    meet code that catches everything. Everything is written atomically, so the process may end at any moment.
    """
    # Python writes the number of every signal that it handles there, whoever's handler it is.
    reader, writer = socket.socketpair()
    writer.setblocking(False)
    signal.set_wakeup_fd(writer.fileno(), warn_on_full_buffer=False)
    numbers = {getattr(signal, name) for name in _SIGNALS if hasattr(signal, name)}

    def watch() -> None:
        # The socket for writing is kept open by this thread as well.
        while writer.fileno() >= 0:
            for number in reader.recv(1):
                if number in numbers:
                    time.sleep(_MAX_SECONDS_TO_END)
                    os._exit(_EXIT_STATUS_BASE + number)

    threading.Thread(target=watch, name="end-after-signal", daemon=True).start()


def _interrupt(number: int, frame: FrameType | None) -> None:
    global _delays
    if _delays < _MOST_DELAYS and _is_within(frame, _is_delaying):
        _delays += 1
        threading.Timer(_DELAY_S, signal.pthread_kill, (threading.main_thread().ident, number)).start()
        return
    for name in _SIGNALS:
        if hasattr(signal, name):
            signal.signal(getattr(signal, name), _end_at_once)
    # Half a module stays behind where an import is broken off, and some packages go on with it.
    if _is_within(frame, _is_importing):
        _say_stopped(_EXIT_STATUS_BASE + number)
        _end_at_once(number, frame)
    raise Interrupted(number)


def _is_importing(code: CodeType) -> bool:
    return code.co_filename == "<frozen importlib._bootstrap>"


def _is_delaying(code: CodeType) -> bool:
    return code in _delaying_code


def _is_within(frame: FrameType | None, is_meant: Callable[[CodeType], bool]) -> bool:
    """Whether the frame or one of its callers runs such code."""
    while frame is not None:
        if is_meant(frame.f_code):
            return True
        frame = frame.f_back
    return False


def _say_stopped(exit_status: int) -> None:
    """What a command prints that is stopped: a word, and its JSON if it is to print any."""
    # The import under way may be that of this very module.
    print_unfinished = getattr(sys.modules.get("flows.cli.outcome"), "print_unfinished", None)
    with suppress(OSError, ValueError):
        sys.stderr.write("stopped\n")
        if print_unfinished is not None:
            print_unfinished("interrupted", exit_status)
        sys.stdout.flush()
        sys.stderr.flush()


def _end_at_once(number: int, frame: FrameType | None) -> None:
    os._exit(_EXIT_STATUS_BASE + number)
