"""The end of every command: an exit status, one line on stderr for an error, and never a traceback unasked for."""

from __future__ import annotations

import errno
import itertools
import os
import platform
import sys
import threading
import time
import traceback
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any

import typer

from flows.cli.outcome import EXIT_CODES, Status, print_unfinished
from flows.cli.signals import Interrupted
from flows.error_record import as_one_line, record_error
from flows.machine.state_folder import find_state_folder
from genre_tasks.errors import ConfigError, InputError

if TYPE_CHECKING:
    from genre_tasks.errors import GenreError

FAULT_EXIT_CODE = 70
"""The exit status after a fault of the program; EX_SOFTWARE of sysexits.h."""
# 128 and the signal's number: SIGHUP, SIGINT, SIGTERM.
_STATUS_BY_CODE: dict[int, Status] = {2: "refused", 129: "interrupted", 130: "interrupted", 143: "interrupted"}
# Wrong paths of the user's that no check has met; other numbers without a file's name say nothing about the cause.
_ERRORS_WITHOUT_A_FILE = frozenset({errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.ENOMEM, errno.EMFILE, errno.ENFILE})
# PyTorch's allocator, the C library, and its loader of shared libraries, which Python reports as an ImportError.
_OUT_OF_MEMORY_PHRASES = ("can't allocate memory", "annot allocate memory", "failed to map segment from shared object")
# Of the options that name a place, those that many commands share.
_PLACE_OPTIONS = frozenset({"--out", "--store"})
_MAX_MESSAGE_LENGTH = 300


def run_guarded(command: Callable[[], None], debug: bool) -> int:
    """Runs a command and translates whatever it raises into one line and an exit status.

    The traceback of a fault goes into a file in ``faults`` of the state folder, see
    :func:`flows.machine.state_folder.find_state_folder`.

    Args:
        command: takes no arguments; to end with a status of its choice it raises ``typer.Exit``.
        debug: whether the traceback is shown too.

    Returns:
        The exit status: 0 after success, 2 after a mistake in the input or the configuration, 1 after another error or
        where a part was left out, 130 after Ctrl-C, 70 after a fault of the program.
    """
    if not debug:
        _keep_background_faults_in_the_log()
    try:
        command()
        # What waits in the buffer is part of the command: a full disk shows here.
        sys.stdout.flush()
    except BaseException as error:
        if debug and not isinstance(error, SystemExit | typer.Exit | Interrupted):
            traceback.print_exception(error)
        return _report(_find_cause(error))
    return 0


def _report(error: BaseException) -> int:
    """Prints what an error means, as a line and, if wanted, as JSON; the exit status."""
    from genre_tasks.errors import GenreError

    if isinstance(error, SystemExit | typer.Exit):
        stated = error.code if isinstance(error, SystemExit) else error.exit_code
        code = stated if isinstance(stated, int) else int(stated is not None)
        if code != 0:
            print_unfinished(_STATUS_BY_CODE.get(code, "failed"), code)
        return code
    if isinstance(error, Interrupted | KeyboardInterrupt):
        code = error.exit_status if isinstance(error, Interrupted) else EXIT_CODES["interrupted"]
        typer.echo("stopped", err=True)
        print_unfinished("interrupted", code)
        return code
    if hasattr(error, "format_message"):
        return _report_usage(error)
    known = error if isinstance(error, GenreError) else _translate(error)
    if known is None:
        return _report_fault(error)
    # Not on stdout: what a command prints there may go into another program.
    typer.echo(f"error: {as_one_line(str(known))}", err=True)
    status = find_status(known)
    print_unfinished(status, EXIT_CODES[status], record_error(known))
    return EXIT_CODES[status]


def find_status(error: GenreError) -> Status:
    """Finds the outcome that an error stands for.

    Args:
        error: what ended the command.

    Returns:
        ``refused`` for a mistake in the input or the configuration, ``partly_done`` where the error says that other
        parts are complete, ``failed`` for everything else.
    """
    stated: Status | None = getattr(error, "status", None)
    return stated or ("refused" if isinstance(error, ConfigError | InputError) else "failed")


def _report_usage(error: Any) -> int:
    """Prints what is wrong with the command line: an option or argument that is unknown, missing or of another type."""
    message = error.format_message()
    if "\n" in message:
        # A command without arguments prints its help.
        error.show()
        return int(error.exit_code)
    remedy = f"See `{error.ctx.command_path} --help`." if getattr(error, "ctx", None) else "See `genre --help`."
    # Some of these messages end with a full stop or a question, some do not.
    sentence = message if message.endswith((".", "?")) else f"{message}."
    typer.echo(f"error: {as_one_line(f'{sentence} {remedy}')}", err=True)
    record = {"class": "UsageError", "message": as_one_line(message), "remedy": remedy}
    print_unfinished("refused", EXIT_CODES["refused"], record)
    return EXIT_CODES["refused"]


def _report_fault(error: BaseException) -> int:
    text = as_one_line(f"{type(error).__name__}: {error}")[:_MAX_MESSAGE_LENGTH]
    frames = traceback.extract_tb(error.__traceback__)
    place = f" ({frames[-1].filename}, line {frames[-1].lineno})" if frames else ""
    file = _write_fault_log("".join(traceback.format_exception(error)))
    where = "no log of it could be written: add --debug" if file is None else f"the log of it is {file}"
    typer.echo(f"error: a fault of ours: {text}{place}; {where}; please report it", err=True)
    record = {"class": type(error).__name__, "message": text, "remedy": "Please report it.", "log_file": file}
    print_unfinished("failed", FAULT_EXIT_CODE, record)
    return FAULT_EXIT_CODE


def _find_cause(error: BaseException) -> BaseException:
    """The first error of a group, in which some libraries wrap even a single one."""
    while isinstance(error, BaseExceptionGroup):
        error = error.exceptions[0]
    return error


def _translate(error: BaseException) -> GenreError | None:
    """The error of ours that says what a system's error means; ``None`` for a fault of the program."""
    from genre_tasks.errors import ResourceError
    from storage.io_errors import as_genre_error

    is_out_of_memory = isinstance(error, MemoryError) or type(error).__name__ == "OutOfMemoryError"
    if is_out_of_memory or any(phrase in str(error) for phrase in _OUT_OF_MEMORY_PHRASES):
        text = as_one_line(str(error))[:_MAX_MESSAGE_LENGTH]
        return ResourceError(
            f"there is not enough memory{f': {text}' if text else ''}",
            remedy="Take smaller images or fewer Gaussians (--set ingest.width_px=…, --set initial.max_points=…), or "
            "end other programs; finished stages are kept.",
        )
    if isinstance(error, OSError) and (error.filename is not None or error.errno in _ERRORS_WITHOUT_A_FILE):
        # Errors of the store are translated by itself: most of those that come here are of what a command writes.
        file = None if error.filename is None else str(error.filename)
        known = as_genre_error(error, Path(), option=None if file is None else _find_option(file))
        # The path above stands for none: not every library names the file.
        known.file = file
        return known
    return None


def _find_option(file: str) -> str | None:
    """The option of the command line that names the file or a folder that it is in; ``None`` where no such one does."""
    words = [part for word in sys.argv[1:] for part in (word.split("=", 1) if word.startswith("--") else (word,))]
    # There may be no working folder any more, and no home folder of a user.
    with suppress(OSError, RuntimeError):
        place = Path(file).absolute()
        for option, value in itertools.pairwise(words):
            if option in _PLACE_OPTIONS and Path(value).expanduser().absolute() in (place, *place.parents):
                return option
    return None


def _write_fault_log(text: str) -> str | None:
    """Appends to this process's log in the state folder; its path, or ``None`` where it cannot be written."""
    facts = f"{time.strftime('%Y-%m-%d %H:%M:%S')}  {sys.argv}\nPython {sys.version}\n{platform.platform()}\n\n"
    name = f"{time.strftime('%Y%m%d')}-{os.getpid()}.log"
    try:
        folder = find_state_folder() / "faults"
        folder.mkdir(exist_ok=True)
        with (folder / name).open("a", encoding="utf-8", errors="backslashreplace") as file:
            file.write(f"{facts}{text}\n")
    except (OSError, ConfigError):
        return None
    return str(folder / name)


def _keep_background_faults_in_the_log() -> None:
    """Sends tracebacks of other threads and of finalizers, which Python prints by itself, into the log."""

    def log_thread(args: threading.ExceptHookArgs) -> None:
        if args.exc_value is not None:
            _write_fault_log("".join(traceback.format_exception(args.exc_value)))

    def log_unraisable(args: Any) -> None:
        if args.exc_value is not None:
            _write_fault_log(f"{args.err_msg}: {args.object!r}\n{''.join(traceback.format_exception(args.exc_value))}")

    threading.excepthook = log_thread
    sys.unraisablehook = log_unraisable
