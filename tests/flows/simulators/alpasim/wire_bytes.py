"""Bytes of protobuf messages put together by hand, from field numbers alone."""

from __future__ import annotations

import struct


def varint(value: int) -> bytes:
    out = bytearray()
    while value > 0x7F:
        out.append(value & 0x7F | 0x80)
        value >>= 7
    return bytes([*out, value])


def key(number: int, wire_type: int) -> bytes:
    return varint(number << 3 | wire_type)


def integer(number: int, value: int) -> bytes:
    """uint32, uint64, bool and enum."""
    return key(number, 0) + varint(value)


def fixed64(number: int, value: int) -> bytes:
    return key(number, 1) + struct.pack("<Q", value)


def double(number: int, value: float) -> bytes:
    return key(number, 1) + struct.pack("<d", value)


def floating(number: int, value: float) -> bytes:
    return key(number, 5) + struct.pack("<f", value)


def block(number: int, content: bytes | str) -> bytes:
    """string, bytes and messages."""
    content = content.encode() if isinstance(content, str) else content
    return key(number, 2) + varint(len(content)) + content


def doubles(number: int, *values: float) -> bytes:
    """repeated double, which proto3 packs."""
    return block(number, struct.pack(f"<{len(values)}d", *values))


def pose(position: tuple[float, float, float], quat: tuple[float, float, float, float]) -> bytes:
    """Pose{Vec3 vec=1, Quat quat=2 (w, x, y, z)}; zeros are left out, as proto3 does."""
    vec = b"".join(floating(k + 1, value) for k, value in enumerate(position) if value)
    turn = b"".join(floating(k + 1, value) for k, value in enumerate(quat) if value)
    return block(1, vec) + block(2, turn)
