"""Damages that any file can have: flipped bits, cuts, splices, wrong numbers and types, nesting, hostile names."""

from __future__ import annotations

import json
import re
import struct
from collections.abc import Callable, Sequence
from random import Random
from typing import Any

Mutation = Callable[[Random, bytes, Sequence[bytes]], bytes]
"""Makes a damaged file from a generator, a valid file and other valid files of the format."""

INTEGERS = (
    0,
    1,
    2,
    127,
    128,
    255,
    32767,
    65535,
    10**6,
    10**9,
    2**31 - 1,
    2**31,
    2**32 - 1,
    2**62,
    2**63 - 1,
    2**64 - 1,
)
"""Integers at which sizes overflow or become absurd."""

MAGICS = (
    *(
        b"\xff\xd8\xff\xe0",
        b"\x89PNG\r\n\x1a\n",
        b"PAR1",
        b"\x76\x2f\x31\x01",
        b"ply\nformat ascii 1.0\n",
        b"PK\x03\x04",
    ),
    *(
        b"\x1f\x8b\x08\x00",
        b"BZh9",
        b"\xfd7zXZ\x00",
        b"\x80\x04\x95",
        b"glTF",
        b"GIF89a",
        b"%!PS-Adobe-3.0",
        b"II*\x00",
    ),
    *(b"RIFF\x00\x00\x00\x00WEBP", b"#usda 1.0\n", b"PXR-USDC", b"<?xml version='1.0'?>", b"\xef\xbb\xbf", b"\xff\xfe"),
)
"""First bytes of other formats."""

HOSTILE_TEXTS = (
    *("", "\0", "../../../../etc/passwd", "/etc/passwd", "..\\..\\windows", "file:///etc/passwd", "~root/x", "CON"),
    *(
        "http://169.254.169.254/latest/meta-data",
        "s3://127.0.0.1:1/x",
        "$(touch x)",
        "`touch x`",
        "%s%n",
        "{0.__class__}",
    ),
    *("\ud7ff\U0001f697", "\u202e", "a" * 5000, "e\u0301" * 50, "__proto__", "NaN", "-inf", "1e999", "'; DROP TABLE x"),
)
"""Names that lead out of a folder, to an address, or into a shell."""

_FAR = 256
_NUMBER = re.compile(rb"-?\d+(?:\.\d+)?(?:[eE][-+]?\d+)?")
_NUMBER_TEXTS = (
    b"NaN",
    b"Infinity",
    b"-Infinity",
    b"1e999",
    b"-1",
    b"0",
    b"1" * 400,
    b"1" * 5000,
    b"0x7fffffff",
    b"1e-400",
)
_MORE_NUMBERS = (
    b"99999999999",
    b"2147483648",
    b"18446744073709551616",
    b"null",
    b'"x"',
    b"[]",
    b"{}",
    b"true",
    b"-0",
    b"01",
)


def _pick_offset(rng: Random, data: bytes | bytearray) -> int:
    # Headers decide most, so that half of the changes fall into the first bytes.
    return rng.randrange(max(1, min(len(data), _FAR) if rng.random() < 0.5 else len(data)))


def keep(rng: Random, data: bytes, others: Sequence[bytes]) -> bytes:
    """Changes nothing: the file must be read."""
    return data


def flip_bits(rng: Random, data: bytes, others: Sequence[bytes]) -> bytes:
    """Flips one to sixteen bits."""
    changed = bytearray(data or b"\0")
    for _ in range(rng.choice((1, 1, 2, 4, 16))):
        changed[_pick_offset(rng, changed)] ^= 1 << rng.randrange(8)
    return bytes(changed)


def cut(rng: Random, data: bytes, others: Sequence[bytes]) -> bytes:
    """Cuts the end off, or leaves zeros where it was."""
    end = rng.randrange(len(data) + 1)
    # A download that stopped leaves zeros where the file was reserved at its size.
    return data[:end] + (bytes(len(data) - end) if rng.random() < 0.3 else b"")


def splice(rng: Random, data: bytes, others: Sequence[bytes]) -> bytes:
    """Joins the beginning of one file and the end of another, or repeats or removes a part."""
    other = rng.choice(others) if others else data
    start = rng.randrange(len(data) + 1)
    kind = rng.randrange(3)
    if kind == 0:
        return data[:start] + other[rng.randrange(len(other) + 1) :]
    end = min(len(data), start + rng.choice((1, 4, 16, 100, 1000)))
    return (
        data[:end] + data[start:end] * rng.choice((1, 2, 50)) + data[end:] if kind == 1 else data[:start] + data[end:]
    )


def write_integer(rng: Random, data: bytes, others: Sequence[bytes]) -> bytes:
    """Writes an integer of one, two, four or eight bytes somewhere, most often into the header."""
    size = rng.choice((1, 2, 4, 4, 8))
    value = rng.choice(INTEGERS) + rng.choice((-1, 0, 0, 1))
    packed = (value % (1 << (8 * size))).to_bytes(size, rng.choice(("little", "big")))
    start = _pick_offset(rng, data)
    return data[:start] + packed + data[start + size :]


def write_float(rng: Random, data: bytes, others: Sequence[bytes]) -> bytes:
    """Writes NaN, an infinity or a number of another size somewhere."""
    value = rng.choice((float("nan"), float("inf"), float("-inf"), 1e30, -1e-38, 0.0))
    packed = struct.pack(rng.choice(("<f", ">f", "<d")), value)
    start = _pick_offset(rng, data)
    return data[:start] + packed + data[start + len(packed) :]


def swap_magic(rng: Random, data: bytes, others: Sequence[bytes]) -> bytes:
    """Begins the file as another format does."""
    magic = rng.choice(MAGICS)
    # In place of the bytes that were there, or before them.
    return magic + (data[len(magic) :] if rng.random() < 0.5 else data)


def make_noise(rng: Random, data: bytes, others: Sequence[bytes]) -> bytes:
    """Replaces a part, or all, by random bytes."""
    if rng.random() < 0.3:
        return rng.randbytes(rng.choice((0, 1, 16, 1000)))
    start = _pick_offset(rng, data)
    noise = rng.randbytes(rng.choice((1, 8, 64)))
    return data[:start] + noise + data[start + len(noise) :]


BYTES: tuple[Mutation, ...] = (
    *(flip_bits, flip_bits, cut, splice, write_integer, write_integer, write_float, swap_magic, make_noise),
)
"""Damages of bytes, whatever they mean."""


def replace_number(rng: Random, data: bytes, others: Sequence[bytes]) -> bytes:
    """Replaces a number in a text by an absurd one or by a value of another type."""
    # Headers of texts are short, and the numbers after them are many.
    found = list(_NUMBER.finditer(data[: 1 << 16]))
    if not found:
        return data
    match = rng.choice(found)
    return data[: match.start()] + rng.choice(_NUMBER_TEXTS + _MORE_NUMBERS) + data[match.end() :]


def write_text(rng: Random, data: bytes, others: Sequence[bytes]) -> bytes:
    """Puts a hostile text somewhere, in one of several encodings."""
    text = rng.choice(HOSTILE_TEXTS).encode(rng.choice(("utf-8", "utf-8", "utf-8", "utf-16", "utf-7")), "replace")
    start = _pick_offset(rng, data)
    return data[:start] + text + data[start + (len(text) if rng.random() < 0.5 else 0) :]


def change_lines(rng: Random, data: bytes, others: Sequence[bytes]) -> bytes:
    """Repeats, removes or exchanges lines."""
    lines = data.split(b"\n")
    first = rng.randrange(len(lines))
    second = rng.randrange(len(lines))
    kind = rng.randrange(3)
    if kind == 0:
        lines.insert(second, lines[first])
    elif kind == 1:
        del lines[first]
    else:
        lines[first], lines[second] = lines[second], lines[first]
    return b"\n".join(lines)


def nest(rng: Random, data: bytes, others: Sequence[bytes]) -> bytes:
    """Nests brackets or mappings thousands deep, around the file or instead of it."""
    depth = rng.choice((40, 900, 5000, 100_000))
    opening = rng.choice((b"[", b'{"a":', b"[[", b'{"a":[', b"- ", b"? "))
    closing = (
        opening.replace(b'"a":', b"").translate(bytes.maketrans(b"[{", b"]}"))[::-1] if opening[0] in b"[{" else b""
    )
    return opening * depth + (data if rng.random() < 0.3 else b"1") + closing * depth


TEXT: tuple[Mutation, ...] = (*BYTES, replace_number, replace_number, replace_number, write_text, change_lines, nest)
"""Damages of texts."""


def make_value(rng: Random) -> Any:
    """Makes a value that no reader expects: of another type, absurdly large, nested, or a hostile name."""
    depth = rng.choice((3, 60, 400))
    nested: Any = 1
    for _ in range(depth):
        nested = [nested] if rng.random() < 0.5 else {"a": nested}
    choices: tuple[Any, ...] = (
        *(None, True, False, -1, 0, 1, 2.5, -0.0, 1e308, 10**18, 10**30, 10**400, 2**31, 2**63, float("nan")),
        *(float("inf"), float("-inf"), [], {}, "", [[]], [None], ["x"], {"x": 1}, [1e999], list(range(300)), nested),
    )
    return rng.choice(HOSTILE_TEXTS) if rng.random() < 0.25 else rng.choice(choices)


def change_value(rng: Random, value: Any) -> Any:
    """Changes one node of a JSON value, in a copy.

    Args:
        rng: the generator.
        value: dictionaries, lists, texts and numbers.

    Returns:
        The value with one node replaced, removed, repeated or added.
    """
    # Deeper with every step, so that leaves are changed as often as the outermost keys.
    if isinstance(value, dict) and value and rng.random() < 0.85:
        changed = dict(value)
        key = rng.choice(list(changed))
        kind = rng.random()
        if kind < 0.7:
            changed[key] = change_value(rng, changed[key])
        elif kind < 0.85:
            del changed[key]
        else:
            changed[rng.choice((*HOSTILE_TEXTS, key + "x"))] = make_value(rng)
        return changed
    if isinstance(value, list) and value and rng.random() < 0.85:
        items = list(value)
        index = rng.randrange(len(items))
        kind = rng.random()
        if kind < 0.7:
            items[index] = change_value(rng, items[index])
        elif kind < 0.85:
            del items[index]
        else:
            items.insert(index, items[index])
        return items
    return make_value(rng)


def dump_json(value: Any) -> bytes:
    """Writes a value as JSON, also where it is NaN, infinite or an integer of many digits."""
    return json.dumps(value, default=str).encode("utf-8", "surrogatepass")


def change_json(rng: Random, data: bytes, others: Sequence[bytes]) -> bytes:
    """Changes a node of a JSON file, which stays JSON."""
    value = json.loads(data)
    for _ in range(rng.choice((1, 1, 2, 4))):
        value = change_value(rng, value)
    return dump_json(value)


def repeat_key(rng: Random, data: bytes, others: Sequence[bytes]) -> bytes:
    """Writes a key of the outermost object twice."""
    value = json.loads(data)
    if not isinstance(value, dict) or not value:
        return change_json(rng, data, others)
    key = rng.choice(list(value))
    return b"{" + dump_json(key) + b": " + dump_json(make_value(rng)) + b", " + dump_json(value)[1:]


JSON: tuple[Mutation, ...] = (*TEXT, *(change_json,) * 10, repeat_key)
"""Damages of JSON files: half of the results are JSON."""
