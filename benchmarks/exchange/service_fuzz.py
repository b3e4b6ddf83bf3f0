"""How a service for simulators takes malformed requests: each is answered with a refusal, and it goes on.

A client sends what it is made of: valid messages, damaged bytes, and messages with odd values in their fields.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from benchmarks.common.bench import Row
from benchmarks.common.claims import Claim, claim

REQUESTS = 10_000
_MAX_NOISE_BYTES = 300
_LISTED_FAULTS = 5


@dataclass(frozen=True)
class Answer:
    """What became of a request.

    Attributes:
        status: in the protocol's own words.
        is_fault: the service failed, where it should have answered or refused.
        detail: what a refusal says; empty for an answer.
        is_refusal: the service refused.
    """

    status: str
    is_fault: bool
    detail: str = ""
    is_refusal: bool = False


class FuzzClient(Protocol):
    """A client of a protocol that can also send nonsense."""

    @property
    def protocol(self) -> str:
        """Name of the protocol."""
        ...

    @property
    def samples(self) -> Mapping[str, Sequence[bytes]]:
        """Valid messages by method."""
        ...

    def send(self, method: str, message: bytes) -> Answer:
        """Sends a message.

        Args:
            method: one of those of ``samples``.
            message: any bytes.
        """
        ...

    def mutate_fields(self, message: bytes, random: np.random.Generator) -> bytes:
        """Changes fields of a valid message into odd values, so that it still reads as a message.

        Args:
            message: valid.
            random: chooses.
        """
        ...

    def is_alive(self) -> bool:
        """Tells whether the service answers a valid request as it should."""
        ...


def damage_bytes(message: bytes, random: np.random.Generator) -> bytes:
    """Damages a message without knowing what it means.

    Args:
        message: valid.
        random: chooses.

    Returns:
        Other bytes: some flipped, cut off, doubled or inserted.

    >>> damage_bytes(b"message", np.random.default_rng(1)) != b"message"
    True
    """
    damaged = bytearray(message)
    kind = random.integers(4)
    place = int(random.integers(len(damaged) + 1))
    if kind == 0 and damaged:
        for index in random.integers(len(damaged), size=int(random.integers(1, 9))):
            damaged[index] ^= int(random.integers(1, 256))
        return bytes(damaged)
    if kind == 1 and damaged:
        return bytes(damaged[:place])
    if kind == 2 and damaged:
        return bytes(damaged + damaged[place:])
    return bytes(damaged[:place]) + random.bytes(int(random.integers(1, 9))) + bytes(damaged[place:])


def make_request(client: FuzzClient, random: np.random.Generator) -> tuple[str, bytes]:
    """Makes one request: noise, a damaged message, one with odd fields, or a valid one.

    Args:
        client: of the service.
        random: chooses.

    Returns:
        Method and message.
    """
    # By message, so that methods with more kinds of messages are asked more often.
    messages = [(method, message) for method, samples in client.samples.items() for message in samples]
    method, message = messages[int(random.integers(len(messages)))]
    kind = random.random()
    if kind < 0.15:
        return method, random.bytes(int(random.integers(_MAX_NOISE_BYTES)))
    if kind < 0.4:
        return method, damage_bytes(message, random)
    if kind < 0.9:
        return method, client.mutate_fields(message, random)
    return method, message


def measure_service_fuzz(client: FuzzClient, requests: int = REQUESTS, seed: int = 0) -> Row:
    """Sends a service many requests, most of them malformed.

    Args:
        client: of the service.
        requests: how many.
        seed: chooses them.

    Returns:
        Counts by status, faults with the first few of them, refusals without a word, and whether the service still
        answers.
    """
    random = np.random.default_rng(seed)
    statuses: Counter[str] = Counter()
    faults: list[str] = []
    silent_refusals = 0
    for _ in range(requests):
        method, message = make_request(client, random)
        answer = client.send(method, message)
        statuses[answer.status] += 1
        silent_refusals += answer.is_refusal and not answer.detail
        if answer.is_fault:
            faults.append(f"{method} {message[:200]!r}: {answer.status} {answer.detail}")
    return {
        "protocol": client.protocol,
        "requests": requests,
        "by_status": dict(sorted(statuses.items())),
        "faults": len(faults),
        "first_faults": faults[:_LISTED_FAULTS],
        "silent_refusals": silent_refusals,
        "alive": client.is_alive(),
    }


def service_fuzz_claims(rows: Sequence[Row]) -> Iterator[Claim]:
    """Claims that no request makes a service fail, that refusals say why, and that services go on.

    Args:
        rows: see :func:`measure_service_fuzz`.
    """
    note = ", ".join(f"{row['requests']} requests to {row['protocol']}" for row in rows) or "no service"
    count = sum(int(row["requests"]) for row in rows)
    faults = sum(int(row["faults"]) for row in rows) if rows else None
    yield claim("exchange.service_faults", faults, "<=", 0, "requests", note, count)
    silent = sum(int(row["silent_refusals"]) for row in rows) if rows else None
    yield claim("exchange.service_silent_refusals", silent, "<=", 0, "requests", note, count)
    alive = min((float(row["alive"]) for row in rows), default=None)
    yield claim("exchange.service_alive", alive, ">=", 1, "part", note, len(rows))


def service_fuzz_table(rows: Sequence[Row]) -> Iterator[str]:
    """Gives a line for each protocol.

    Args:
        rows: see :func:`measure_service_fuzz`.
    """
    yield "| protocol | requests | answers by status | faults | still answers |"
    yield "|---|---|---|---|---|"
    for row in rows:
        statuses = ", ".join(f"{status}: {count}" for status, count in row["by_status"].items())
        alive = "yes" if row["alive"] else "no"
        yield f"| {row['protocol']} | {row['requests']} | {statuses} | {row['faults']} | {alive} |"
