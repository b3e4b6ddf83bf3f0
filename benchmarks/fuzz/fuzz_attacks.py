"""Files made to do harm: pickles that run code, bombs of images and tables, tags of YAML, absurd headers."""

from __future__ import annotations

import gzip
import io
import json
import pickle
import pickletools
import struct
import zlib
from collections.abc import Callable, Sequence
from random import Random
from typing import Any

from benchmarks.fuzz.fuzz_mutations import INTEGERS, change_value, dump_json

CANARY = "fuzz_canary"
"""Name of the file that code in an input would write into the current folder."""

_SIDES = (0, 1, 15_000, 65_535, 100_000, 2**31 - 1, 2**32 - 1)


class _RunsCode:
    """What unpickles by calling a function."""

    def __init__(self, function: Callable[..., Any], *arguments: Any) -> None:
        self._call = (function, arguments)

    def __reduce__(self) -> tuple[Callable[..., Any], tuple[Any, ...]]:
        return self._call


def make_running_pickle(rng: Random, data: bytes, others: Sequence[bytes]) -> bytes:
    """Makes a pickle that writes the canary when it is unpickled, alone or inside of a table's pickle."""
    import os
    import subprocess

    code = f"open({CANARY!r}, 'w').close()"
    harmful = rng.choice(
        (
            *(_RunsCode(os.system, f"touch {CANARY}"), _RunsCode(eval, code), _RunsCode(exec, code)),
            *(
                _RunsCode(open, CANARY, "w"),
                _RunsCode(subprocess.call, ["touch", CANARY]),
                _RunsCode(__import__, "this"),
            ),
        )
    )
    payload = pickle.dumps(rng.choice((harmful, [harmful], {"x": harmful})), protocol=rng.randrange(6))
    if rng.random() < 0.5:
        return payload
    # Its opcodes before those of the table, whose own protocol mark may stand anywhere.
    return payload[:-1] + b"0" + data


def change_pickle(rng: Random, data: bytes, others: Sequence[bytes]) -> bytes:
    """Changes the argument of one opcode, or repeats or removes an opcode."""
    try:
        positions = [position or 0 for _, _, position in pickletools.genops(data)] + [len(data)]
    except Exception:
        return data[: len(data) // 2]
    index = rng.randrange(len(positions) - 1)
    start, end = positions[index], positions[index + 1]
    code = data[start:end]
    kind = rng.randrange(5)
    if kind == 0:
        code = b"J" + struct.pack("<i", rng.choice(INTEGERS) % 2**31)
    elif kind == 1:
        code = b"\x8a\x09" + (rng.choice(INTEGERS) + 1).to_bytes(9, "little")
    elif kind == 2:
        code = code * rng.choice((2, 100))
    elif kind == 3:
        code = rng.choice((b"N", b"}", b"]", b")", b"(", b"0", b"2", b"Q", b"\x82\x01", b"i", b"cos\nsystem\n", b"R"))
    else:
        code = b""
    return data[:start] + code + data[end:]


def compress_pickle(rng: Random, data: bytes, others: Sequence[bytes]) -> bytes:
    """Compresses a pickle, much of zeros, or a pickle that doubles a list many times."""
    kind = rng.randrange(4)
    if kind == 0:
        return gzip.compress(data, 1)[: rng.choice((None, 40))]
    if kind == 1:
        return gzip.compress(bytes(rng.choice((1 << 20, 64 << 20))), 1)
    if kind == 2:
        # Every level holds the last one ten times: a billion values in a few hundred bytes.
        level = b"]q\x00"
        for k in range(1, 40):
            level += b"](" + b"h" + bytes([k - 1]) + (b"h" + bytes([k - 1])) * 9 + b"eq" + bytes([k])
        return b"\x80\x02" + level + b"."
    return b"\x80\x04" + b"(" * rng.choice((1000, 100_000)) + b"l" * 100 + b"."


def make_long_pickle(rng: Random, data: bytes, others: Sequence[bytes]) -> bytes:
    """Makes a small file of very many opcodes."""
    opcodes = rng.choice((b"K\x01", b"]", b"}", b"\x89", b"(t", b"N"))
    return gzip.compress(b"\x80\x02](" + opcodes * rng.choice((10_000, 8_000_000)) + b"e.", 1)


def make_odd_table(rng: Random, data: bytes, others: Sequence[bytes]) -> bytes:
    """Makes a pickle of a sound table that has odd values, types or columns."""
    import numpy as np

    from genre_tasks.logs.pandaset.pickle_reader import parse_table
    from genre_tasks.logs.pandaset.pickle_writer import pickle_table

    columns = dict(parse_table(data).columns)
    name = rng.choice(list(columns))
    count = len(columns[name])
    kind = rng.randrange(4)
    if kind == 0:
        del columns[name]
        name = rng.choice(list(columns))
    if kind == 1:
        columns = {key: values[:0] for key, values in columns.items()}
    elif kind == 2:
        columns[name] = np.array(
            [rng.choice((None, "", "x", 1.5, float("nan"), "1")) for _ in range(count)], dtype=object
        )
    else:
        columns[name] = np.array([rng.choice((0.0, -1.0, 1e300, float("nan"), float("inf"))) for _ in range(count)])
    return pickle_table(columns)


YAML_ATTACKS = (
    f"!!python/object/apply:os.system ['touch {CANARY}']\n",
    f"a: !!python/object/new:subprocess.Popen [['touch', '{CANARY}']]\n",
    f"!!python/object/apply:builtins.exec [\"open('{CANARY}', 'w')\"]\n",
    "a: !!python/name:os.system\nb: !!python/module:this\n",
    "a: &a [x, x]\nb: &b [*a, *a]\nc: &c [*b, *b]\nd: [*c, *c]\n",
    "a: &a\n  b: *a\n",
    "<<: {a: 1}\n",
    "%YAML 9.9\n---\na: 1\n",
    "%TAG ! tag:evil:\n---\n!x a: 1\n",
    "a: 1\n---\nb: 2\n",
    "? [a, b]\n: 1\n",
    "a: |\n" + "  x\n" * 1000,
    "a: !!binary aGVsbG8=\nb: !!set {x, y}\nc: !!timestamp 2001-01-01\n",
    "a: " + "9" * 5000 + "\n",
    "a: 1:30\nb: 0o17\nc: .inf\nd: -.nan\ne: 1_000\n",
    "a: {" * 31 + "\n",
    "\tkey: value\n",
    "a: 'never closed\n",
    "key: \x07\n",
)
"""YAML that calls functions, repeats itself, or has values that parsers disagree about."""


def attack_yaml(rng: Random, data: bytes, others: Sequence[bytes]) -> bytes:
    """Puts one of ``YAML_ATTACKS`` before, after or in place of the file."""
    attack = rng.choice(YAML_ATTACKS).encode()
    return rng.choice((attack, attack + data, data + attack, data.replace(b": ", b": " + attack.split(b"\n")[0], 1)))


def _pack_chunk(name: bytes, content: bytes) -> bytes:
    return struct.pack(">I", len(content)) + name + content + struct.pack(">I", zlib.crc32(name + content))


def change_png(rng: Random, data: bytes, others: Sequence[bytes]) -> bytes:
    """Changes a PNG's sizes, depth or chunks, with right checksums, or fills it with zeros that compress well."""
    chunks = []
    position = 8
    while position + 8 <= len(data):
        (length,) = struct.unpack_from(">I", data, position)
        chunks.append((data[position + 4 : position + 8], data[position + 8 : position + 8 + length]))
        position += length + 12
    header = bytearray(chunks[0][1])
    # Checksums are computed again below, so that decoders get to see the change.
    kind = rng.randrange(5)
    if kind == 0:
        struct.pack_into(">II", header, 0, rng.choice(_SIDES), rng.choice(_SIDES))
    elif kind == 1:
        header[8 + rng.randrange(5)] = rng.choice((0, 1, 2, 3, 4, 6, 8, 16, 255))
    elif kind == 2:
        content = rng.choice((b"x\0\0" + zlib.compress(bytes(80 << 20), 1), b"gama", b"", rng.randbytes(30)))
        name = rng.choice(
            (b"zTXt", b"iCCP", b"iTXt", b"gAMA", b"cHRM", b"sBIT", b"tRNS", b"PLTE", b"cICP", b"eXIf", b"acTL")
        )
        chunks.insert(1, (name, content))
    elif kind == 3:
        side = rng.choice((3000, 9000))
        struct.pack_into(">II", header, 0, side, side)
        chunks[1] = (b"IDAT", zlib.compress(bytes(side * (3 * side + 1)), 1))
    else:
        chunks[rng.randrange(len(chunks))] = chunks[rng.randrange(len(chunks))]
    if chunks[0][0] == b"IHDR":
        chunks[0] = (b"IHDR", bytes(header))
    return data[:8] + b"".join(_pack_chunk(name, content) for name, content in chunks)


def change_jpeg(rng: Random, data: bytes, others: Sequence[bytes]) -> bytes:
    """Changes a JPEG's size or a segment's length, or repeats its last scan many times."""
    frame = max(data.find(b"\xff\xc0"), data.find(b"\xff\xc2"))
    scan = data.rfind(b"\xff\xda")
    kind = rng.randrange(4)
    # Baseline and progressive frames begin alike: length, depth, height, width.
    if kind == 0 and frame > 0:
        sides = struct.pack(">HH", *(min(rng.choice(_SIDES), 65_535) for _ in range(2)))
        return data[: frame + 5] + sides + data[frame + 9 :]
    if kind == 1:
        marker = data.find(b"\xff" + rng.choice((b"\xc0", b"\xc2", b"\xc4", b"\xdb", b"\xda", b"\xe0")))
        return data[: marker + 2] + struct.pack(">H", rng.choice((0, 1, 2, 3, 65_535))) + data[marker + 4 :]
    if kind == 2 and scan > 0 and b"\xff\xc2" in data:
        side = struct.pack(">HH", 5000, 5000)
        wide = data[: frame + 5] + side + data[frame + 9 :]
        return wide[:-2] + data[scan:-2] * rng.choice((50, 1500)) + data[-2:]
    exif = b"Exif\0\0" + rng.choice((b"II*\0\x08\0\0\0", b"MM\0*\0\0\0\x08")) + rng.randbytes(40)
    return data[:2] + b"\xff\xe1" + struct.pack(">H", len(exif) + 2) + exif + data[2:]


def change_safetensors(rng: Random, data: bytes, others: Sequence[bytes]) -> bytes:
    """Changes the JSON header or its length."""
    # A length of eight bytes, then JSON of that length, then the tensors.
    (length,) = struct.unpack_from("<Q", data)
    header = json.loads(data[8 : 8 + length])
    body = data[8 + length :]
    kind = rng.randrange(5)
    if kind == 0:
        return struct.pack("<Q", (rng.choice(INTEGERS) + rng.choice((-1, 0, 1))) % 2**64) + data[8:]
    if kind == 1:
        text = b"[" * rng.choice((200, 100_000))
    elif kind == 2:
        text = dump_json(header)[:-1] + b"," + dump_json(header)[1:]
    else:
        text = dump_json(change_value(rng, header))
    return struct.pack("<Q", len(text)) + text + body


def change_glb(rng: Random, data: bytes, others: Sequence[bytes]) -> bytes:
    """Changes the JSON of a binary glTF, with right lengths."""
    (length,) = struct.unpack_from("<I", data, 12)
    value = json.loads(data[20 : 20 + length])
    for _ in range(rng.choice((1, 2))):
        value = change_value(rng, value)
    text = dump_json(value)
    # Parts of the file begin at multiples of four.
    text += b" " * (-len(text) % 4)
    body = data[20 + length :]
    header = struct.pack("<4sIIII", b"glTF", 2, 20 + len(text) + len(body), len(text), 0x4E4F534A)
    return header + text + body


def change_exr(rng: Random, data: bytes, others: Sequence[bytes]) -> bytes:
    """Changes the windows, the channels or another attribute in the header of an EXR file, or makes a large one."""
    if rng.random() < 0.02:
        return _make_large_exr(rng.choice((2000, 6000)))
    name = rng.choice((b"dataWindow\0", b"displayWindow\0", b"channels\0", b"compression\0", b"lineOrder\0"))
    start = data.find(name)
    if start < 0:
        return data[:100]
    start += len(name)
    start = data.find(b"\0", start) + 1
    (length,) = struct.unpack_from("<i", data, start)
    if name.endswith(b"Window\0") and rng.random() < 0.8:
        corners = [rng.choice((0, 0, -1, 5, *_SIDES)) for _ in range(4)]
        packed = b"".join(struct.pack("<I", corner % 2**32) for corner in corners)
        return data[: start + 4] + packed + data[start + 20 :]
    if rng.random() < 0.3:
        return data[:start] + struct.pack("<I", rng.choice(INTEGERS) % 2**32) + data[start + 4 :]
    where = start + 4 + rng.randrange(max(1, length))
    return data[:where] + bytes([rng.randrange(256)]) + data[where + 1 :]


def _make_large_exr(side: int) -> bytes:
    import numpy as np
    import OpenEXR

    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    pixels = {"R": np.zeros((side, side), np.float16), "Z": np.zeros((side, side), np.float32)}
    sink = io.BytesIO()
    with OpenEXR.File(header, pixels) as file:
        file.write(sink)
    return sink.getvalue()
