"""Reads a pickle into a tree of plain values without ever calling or importing anything.

PandaSet's sweeps and cuboids are pickles, and a pickle is a program: ``pickle.load`` would run whatever it asks for.
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


class PickleRefusedError(Exception):
    """The pickle asks for something that is not allowed: ``asked_for`` names it."""

    def __init__(self, asked_for: str) -> None:
        super().__init__(f"refused: {asked_for}")
        self.asked_for = asked_for


class PickleBrokenError(Exception):
    """The bytes are no well-formed pickle of the supported opcodes."""


@dataclass(frozen=True)
class Global:
    """A global of the allow-list, by its name there; never an object of Python."""

    name: str


@dataclass(eq=False)
class Call:
    """The note "``function(*args)`` was asked for", with the state that BUILD handed over afterwards (at most once)."""

    function: str
    args: tuple[Any, ...]
    state: Any = None


_MARK = object()
_LITERALS: Mapping[str, object] = {"NONE": None, "NEWTRUE": True, "NEWFALSE": False, "EMPTY_TUPLE": ()}
_ARGUMENT_IS_VALUE = frozenset(
    {"BININT", "BININT1", "BININT2", "LONG1", "LONG4", "BINFLOAT", "SHORT_BINUNICODE", "BINUNICODE", "BINUNICODE8"}
    | {"SHORT_BINBYTES", "BINBYTES", "BINBYTES8", "BYTEARRAY8"}
)
_SHORT_TUPLES = {"TUPLE1": 1, "TUPLE2": 2, "TUPLE3": 3}


class _Machine:
    """The stack, the memo, and one method per kind of opcode."""

    def __init__(self, allowed: Mapping[tuple[str, str], str]) -> None:
        self.allowed = allowed
        self.stack: list[object] = []
        self.memo: dict[int, object] = {}
        self.steps: dict[str, Callable[[object], None]] = {
            "PROTO": lambda _: None,
            "FRAME": lambda _: None,
            "MARK": lambda _: self.stack.append(_MARK),
            "POP": lambda _: self._drop(),
            "EMPTY_LIST": lambda _: self.stack.append([]),
            "EMPTY_DICT": lambda _: self.stack.append({}),
            "TUPLE": lambda _: self.stack.append(tuple(self._since_mark())),
            "APPEND": lambda _: self._extend([self.pop()]),
            "APPENDS": lambda _: self._extend(self._since_mark()),
            "SETITEM": lambda _: self._update([self.pop(), self.pop()][::-1]),
            "SETITEMS": lambda _: self._update(self._since_mark()),
            "MEMOIZE": lambda _: self._put(len(self.memo)),
            "BINPUT": self._put,
            "LONG_BINPUT": self._put,
            "BINGET": self._get,
            "LONG_BINGET": self._get,
            "GLOBAL": lambda arg: self._global(*str(arg).split(" ", 1)),
            "STACK_GLOBAL": lambda _: self._global(*[self.pop(), self.pop()][::-1]),
            "REDUCE": lambda _: self._call(),
            "NEWOBJ": lambda _: self._call(),
            "BUILD": lambda _: self._build(),
        }

    def pop(self) -> object:
        if not self.stack or self.stack[-1] is _MARK:
            raise PickleBrokenError("the pickle takes more from its stack than it put there")
        return self.stack.pop()

    def step(self, opcode: str, argument: object) -> None:
        if opcode in _LITERALS:
            self.stack.append(_LITERALS[opcode])
        elif opcode in _ARGUMENT_IS_VALUE:
            self.stack.append(argument)
        elif opcode in _SHORT_TUPLES:
            self.stack.append(tuple([self.pop() for _ in range(_SHORT_TUPLES[opcode])][::-1]))
        elif opcode in self.steps:
            self.steps[opcode](argument)
        else:
            raise PickleRefusedError(f"opcode {opcode}")

    def _drop(self) -> None:
        if not self.stack:
            raise PickleBrokenError("the pickle takes more from its stack than it put there")
        self.stack.pop()

    def _since_mark(self) -> list[object]:
        for start in range(len(self.stack) - 1, -1, -1):
            if self.stack[start] is _MARK:
                values = self.stack[start + 1 :]
                del self.stack[start:]
                return values
        raise PickleBrokenError("the pickle closes a list that it did not open")

    def _extend(self, values: list[object]) -> None:
        target = self.stack[-1] if self.stack else None
        if not isinstance(target, list):
            raise PickleRefusedError("appending to something that is not a list")
        target.extend(values)

    def _update(self, pairs: list[object]) -> None:
        target = self.stack[-1] if self.stack else None
        # Keys are strings only: hashing a deeply nested tuple overflows the interpreter's own stack.
        if not isinstance(target, dict) or len(pairs) % 2 or not all(type(key) is str for key in pairs[::2]):
            raise PickleRefusedError("a dictionary whose keys are not strings")
        target.update(zip(pairs[::2], pairs[1::2], strict=True))

    def _put(self, index: object) -> None:
        if not self.stack or self.stack[-1] is _MARK or not isinstance(index, int):
            raise PickleBrokenError("the pickle memorises nothing")
        self.memo[index] = self.stack[-1]

    def _get(self, index: object) -> None:
        if index not in self.memo:
            raise PickleBrokenError("the pickle recalls what it did not memorise")
        self.stack.append(self.memo[index])  # type: ignore[index]

    def _global(self, *names: object) -> None:
        if len(names) != 2 or not all(type(name) is str for name in names):
            raise PickleRefusedError("a global whose name is not text")
        module, name = str(names[0]), str(names[1])
        if (module, name) not in self.allowed:
            raise PickleRefusedError(f"{module}.{name}")
        self.stack.append(Global(self.allowed[module, name]))

    def _call(self) -> None:
        args, function = self.pop(), self.pop()
        if not isinstance(function, Global) or not isinstance(args, tuple):
            raise PickleRefusedError("a call of something that is not a global")
        self.stack.append(Call(function.name, args))

    def _build(self) -> None:
        state, target = self.pop(), self.stack[-1] if self.stack else None
        if not isinstance(target, Call) or target.state is not None:
            raise PickleRefusedError("a change of something that the pickle did not make")
        target.state = state


def read_pickle_tree(data: bytes, allowed: Mapping[tuple[str, str], str]) -> object:
    """The value that a pickle describes, with ``Call`` nodes where it asks for a global.

    Args:
        data: the pickle, protocol 2 to 5; nothing is allocated beyond what its bytes hold.
        allowed: (module, name) → the name that ``Call.function`` and ``Global.name`` carry.

    Raises:
        PickleRefusedError: it asks for a global, or uses an opcode, that is not allowed.
        PickleBrokenError: truncated or malformed.
    """
    machine = _Machine(allowed)
    try:
        for opcode, argument, _ in pickletools.genops(data):
            if opcode.name == "STOP":
                return machine.pop()
            machine.step(opcode.name, argument)
    except (ValueError, IndexError, OverflowError) as error:
        # What pickletools raises on truncated or malformed bytes (UnicodeDecodeError and struct.error's cousins).
        raise PickleBrokenError(str(error)) from error
    raise PickleBrokenError("the pickle has no end")
