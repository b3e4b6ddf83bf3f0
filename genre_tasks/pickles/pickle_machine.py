"""Reads a pickle into a tree of plain values without ever calling or importing anything.

PandaSet's sweeps and some networks' weights are pickles, and a pickle is a program: ``pickle.load`` would run it.
Here the opcodes are interpreted by a small stack machine that knows only how to make values (numbers, strings, bytes,
tuples, lists, dictionaries) and, for a global on the caller's allow-list, a ``Call`` node: a note that the pickle
asked for it. What a note means is decided afterwards by the caller; any other global ends the reading at once.
Extension registry, persistent ids, out-of-band buffers and the text opcodes of protocols 0 and 1 are not known at all.
"""

from __future__ import annotations

import pickletools
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

MAX_OPCODES = 2_000_000
"""A table has a few for every column and for every cell that is text; more would take minutes and gigabytes."""


class PickleRefusedError(Exception):
    """The pickle asks for something that is not allowed.

    Attributes:
        asked_for: names it.
    """

    def __init__(self, asked_for: str) -> None:
        super().__init__(f"refused: {asked_for}")
        self.asked_for = asked_for


class PickleBrokenError(Exception):
    """The bytes are no well-formed pickle of the supported opcodes."""


@dataclass(frozen=True)
class Global:
    """A global of the allow-list; never an object of Python.

    Attributes:
        name: the name that the allow-list gives it.
    """

    name: str


@dataclass(eq=False)
class Call:
    """A note that the pickle asked for ``function(*args)``.

    Attributes:
        function: the function's name on the allow-list.
        args: its arguments, values and notes.
        state: what the opcode BUILD set afterwards, at most once; ``None`` before.
    """

    function: str
    args: tuple[Any, ...]
    state: Any = None


# An object of its own, which no pickle can push as a value.
_MARK = object()
_CONSTANTS: Mapping[str, object] = {"NONE": None, "NEWTRUE": True, "NEWFALSE": False, "EMPTY_TUPLE": ()}
# Opcodes whose argument is the value that they push.
_VALUE_OPCODES = frozenset(
    {"BININT", "BININT1", "BININT2", "LONG1", "LONG4", "BINFLOAT", "SHORT_BINUNICODE", "BINUNICODE", "BINUNICODE8"}
    | {"SHORT_BINBYTES", "BINBYTES", "BINBYTES8", "BYTEARRAY8"}
)

_TUPLE_LENGTHS = {"TUPLE1": 1, "TUPLE2": 2, "TUPLE3": 3}


class _StackMachine:
    """The stack and the memo of an unpickler, and one method per kind of opcode."""

    def __init__(self, allowed: Mapping[tuple[str, str], str]) -> None:
        self.allowed = allowed
        self.stack: list[object] = []
        self.memo: dict[int, object] = {}
        self.handlers: dict[str, Callable[[object], None]] = {
            # Protocol and framing only help a reader of streams.
            "PROTO": lambda _: None,
            "FRAME": lambda _: None,
            "MARK": lambda _: self.stack.append(_MARK),
            "POP": lambda _: self._discard(),
            "EMPTY_LIST": lambda _: self.stack.append([]),
            "EMPTY_DICT": lambda _: self.stack.append({}),
            "TUPLE": lambda _: self.stack.append(tuple(self._pop_to_mark())),
            "APPEND": lambda _: self._extend_list([self.pop()]),
            "APPENDS": lambda _: self._extend_list(self._pop_to_mark()),
            "SETITEM": lambda _: self._update_dict(self._pop_many(2)),
            "SETITEMS": lambda _: self._update_dict(self._pop_to_mark()),
            "MEMOIZE": lambda _: self._memorise(len(self.memo)),
            "BINPUT": self._memorise,
            "LONG_BINPUT": self._memorise,
            "BINGET": self._recall,
            "LONG_BINGET": self._recall,
            "GLOBAL": lambda argument: self._push_global(*str(argument).split(" ", 1)),
            "STACK_GLOBAL": lambda _: self._push_global(*self._pop_many(2)),
            "REDUCE": lambda _: self._push_call(),
            "NEWOBJ": lambda _: self._push_call(),
            "BUILD": lambda _: self._set_state(),
        }

    def execute(self, opcode: str, argument: object) -> None:
        """Carries out one opcode, named as in ``pickletools``."""
        if opcode in _CONSTANTS:
            self.stack.append(_CONSTANTS[opcode])
        elif opcode in _VALUE_OPCODES:
            self.stack.append(argument)
        elif opcode in _TUPLE_LENGTHS:
            self.stack.append(tuple(self._pop_many(_TUPLE_LENGTHS[opcode])))
        elif opcode in self.handlers:
            self.handlers[opcode](argument)
        else:
            raise PickleRefusedError(f"opcode {opcode}")

    def pop(self) -> object:
        """Takes the topmost value from the stack; a mark is no value."""
        if not self.stack or self.stack[-1] is _MARK:
            raise PickleBrokenError("the pickle takes more from its stack than it put there")
        return self.stack.pop()

    def _pop_many(self, count: int) -> list[object]:
        """The topmost values, in the order in which they were pushed."""
        return [self.pop() for _ in range(count)][::-1]

    def _pop_to_mark(self) -> list[object]:
        # From the top down, since marks nest.
        for start in range(len(self.stack) - 1, -1, -1):
            if self.stack[start] is _MARK:
                values = self.stack[start + 1 :]
                del self.stack[start:]
                return values
        raise PickleBrokenError("the pickle closes a list that it did not open")

    def _discard(self) -> None:
        if not self.stack:
            raise PickleBrokenError("the pickle takes more from its stack than it put there")
        self.stack.pop()

    def _extend_list(self, values: list[object]) -> None:
        target = self.stack[-1] if self.stack else None
        if not isinstance(target, list):
            raise PickleRefusedError("appending to something that is not a list")
        target.extend(values)

    def _update_dict(self, pairs: list[object]) -> None:
        target = self.stack[-1] if self.stack else None
        # Keys are strings only: hashing a deeply nested tuple overflows the interpreter's own stack.
        if not isinstance(target, dict) or len(pairs) % 2 or not all(type(key) is str for key in pairs[::2]):
            raise PickleRefusedError("a dictionary whose keys are not strings")
        target.update(zip(pairs[::2], pairs[1::2], strict=True))

    def _memorise(self, index: object) -> None:
        if not self.stack or self.stack[-1] is _MARK or not isinstance(index, int):
            raise PickleBrokenError("the pickle memorises nothing")
        self.memo[index] = self.stack[-1]

    def _recall(self, index: object) -> None:
        if index not in self.memo:
            raise PickleBrokenError("the pickle recalls what it did not memorise")
        self.stack.append(self.memo[index])  # type: ignore[index]

    def _push_global(self, *names: object) -> None:
        if len(names) != 2 or not all(type(name) is str for name in names):
            raise PickleRefusedError("a global whose name is not text")
        key = (str(names[0]), str(names[1]))
        # Looked up as an exact pair and never imported: a dotted name cannot reach into an allowed module.
        if key not in self.allowed:
            raise PickleRefusedError(".".join(key))
        self.stack.append(Global(self.allowed[key]))

    def _push_call(self) -> None:
        function, args = self._pop_many(2)
        # What a call returned is no function: ``getattr(os, "system")(…)`` ends here.
        if not isinstance(function, Global) or not isinstance(args, tuple):
            raise PickleRefusedError("a call of something that is not a global")
        self.stack.append(Call(function.name, args))

    def _set_state(self) -> None:
        state = self.pop()
        target = self.stack[-1] if self.stack else None
        # At most once, or a pickle could replace a state after its parts were checked.
        if not isinstance(target, Call) or target.state is not None:
            raise PickleRefusedError("a change of something that the pickle did not make")
        target.state = state


def read_pickle_tree(data: bytes, allowed: Mapping[tuple[str, str], str]) -> object:
    """Reads the value that a pickle describes, with ``Call`` nodes where it asks for a global.

    Args:
        data: the pickle, protocol 2 to 5; nothing is allocated beyond what its bytes hold.
        allowed: (module, name) → the name that ``Call.function`` and ``Global.name`` carry.

    Returns:
        The value.

    Raises:
        PickleRefusedError: the pickle asks for a global, or uses an opcode, that is not allowed.
        PickleBrokenError: truncated or malformed bytes.

    >>> import pickle
    >>> read_pickle_tree(pickle.dumps({"x": [1.0, "a"]}), {})
    {'x': [1.0, 'a']}
    >>> read_pickle_tree(pickle.dumps(print), {})
    Traceback (most recent call last):
    ...
    genre_tasks.pickles.pickle_machine.PickleRefusedError: refused: builtins.print
    """
    machine = _StackMachine(allowed)
    try:
        for number, (opcode, argument, _) in enumerate(pickletools.genops(data)):
            if number >= MAX_OPCODES:
                raise PickleRefusedError(f"more than {MAX_OPCODES} opcodes")
            if opcode.name == "STOP":
                return machine.pop()
            machine.execute(opcode.name, argument)
    except (ValueError, IndexError, OverflowError) as error:
        # What pickletools raises on truncated or malformed bytes (UnicodeDecodeError and struct.error's cousins).
        raise PickleBrokenError(str(error)) from error
    raise PickleBrokenError("the pickle has no end")
