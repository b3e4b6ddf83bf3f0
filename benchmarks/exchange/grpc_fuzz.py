"""Damaged and absurd requests to the sensor service: each gets a status code, and the service goes on."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Iterator, Sequence

import grpc
import numpy as np
import torch
from google.protobuf.descriptor import FieldDescriptor
from google.protobuf.message import Message

from benchmarks.common.bench import Row
from benchmarks.common.claims import Claim, claim
from benchmarks.common.context import THREADS
from benchmarks.exchange.simulator_client import Simulator, ask, make_plain_request
from flows.simulators.alpasim import sensorsim_pb2
from flows.simulators.alpasim.local_frame import read_local_frame
from flows.simulators.alpasim.sensor_service import SensorService, ServedScene
from flows.simulators.alpasim.server import REQUEST_TYPES, SERVICE, SensorServer
from flows.simulators.image_request import RenderLimits
from flows.simulators.scene_renderer import SceneRenderer

REQUESTS = 10_000
REFUSALS = frozenset({"OK", "INVALID_ARGUMENT", "UNIMPLEMENTED", "RESOURCE_EXHAUSTED", "OUT_OF_RANGE"})
"""Statuses that say what is wrong with a request. Any other one says that the service has a fault."""

_LIMIT_PX = 128
_NUMBERS = (0.0, -1.0, 1.0, 0.5, 1e-30, 1e6, -1e6, 1e30, math.inf, -math.inf, math.nan)
_INTEGERS = (0, 1, 2, 5, 64, 77, 1 << 15, (1 << 31) - 1, (1 << 32) - 1)
_LARGE_INTEGERS = (*_INTEGERS, 1 << 40, (1 << 63) - 1, (1 << 64) - 1)
_TEXTS = ("", "EGO", "car-0", "car-1", "../x", "\x00", "ü" * 300, "1" * 5000)
_FLOAT_TYPES = (FieldDescriptor.TYPE_DOUBLE, FieldDescriptor.TYPE_FLOAT)
_LARGE_TYPES = (FieldDescriptor.TYPE_FIXED64, FieldDescriptor.TYPE_UINT64)


def measure_grpc_fuzz(store: str, run: str, requests: int = REQUESTS, seed: int = 0) -> Row:
    """Sends damaged requests of all kinds, each made from a good one.

    Args:
        store: folder of the store.
        run: the run's name, or the start of it.
        requests: how many.
        seed: of what is damaged.

    Returns:
        How many answers had each status, ``faults`` among them, and whether a good request is answered afterwards.
    """
    torch.set_num_threads(THREADS)
    limits = RenderLimits(max_width_px=_LIMIT_PX, max_height_px=_LIMIT_PX, max_batch=3)
    renderer = SceneRenderer(store, run, limits=limits)
    service = SensorService({renderer.name: ServedScene(renderer, read_local_frame(renderer.scenes))})
    rng = np.random.default_rng(seed)
    statuses: Counter[str] = Counter()
    with SensorServer(service) as server:
        simulator = Simulator.connect(server.address)
        good = make_plain_request(simulator, (64, 40))
        for k in range(requests):
            method, payload = _DAMAGES[k % len(_DAMAGES)](good, rng)
            statuses[_send(simulator.channel, method, payload)] += 1
        answered = bool(ask(simulator.channel, "render_rgb", good, sensorsim_pb2.RGBRenderReturn).image_bytes)
        simulator.channel.close()
    faults = sum(count for status, count in statuses.items() if status not in REFUSALS)
    counts = dict(sorted(statuses.items()))
    log = str(renderer.scenes.record["log"])
    return {"log": log, "requests": requests, "statuses": counts, "faults": faults, "answered": answered}


def _send(channel: grpc.Channel, method: str, payload: bytes) -> str:
    try:
        channel.unary_unary(f"/{SERVICE}/{method}")(payload, timeout=60)
    except grpc.RpcError as error:
        return str(error.code().name)
    return "OK"


Damage = tuple[str, bytes]


def _send_noise(good: sensorsim_pb2.RGBRenderRequest, rng: np.random.Generator) -> Damage:
    return _choose_method(rng), rng.bytes(int(rng.integers(0, 400)))


def _change_bytes(good: sensorsim_pb2.RGBRenderRequest, rng: np.random.Generator) -> Damage:
    payload = bytearray(good.SerializeToString())
    for place in rng.integers(0, len(payload), rng.integers(1, 8)):
        payload[place] = rng.integers(0, 256)
    return "render_rgb", bytes(payload)


def _cut_or_repeat(good: sensorsim_pb2.RGBRenderRequest, rng: np.random.Generator) -> Damage:
    payload = good.SerializeToString()
    first, last = sorted(rng.integers(0, len(payload), 2).tolist())
    cut = payload[:last] if rng.random() < 0.5 else payload[:last] + payload[first:]
    return _choose_method(rng), cut


def _change_values(good: sensorsim_pb2.RGBRenderRequest, rng: np.random.Generator) -> Damage:
    return "render_rgb", _with_changed_values(good, rng).SerializeToString()


def _change_batch(good: sensorsim_pb2.RGBRenderRequest, rng: np.random.Generator) -> Damage:
    batch = sensorsim_pb2.BatchRGBRenderRequest()
    for _ in range(int(rng.integers(0, 5))):
        batch.items.add(camera_name="front", request=_with_changed_values(good, rng))
    return "batch_render_rgb", batch.SerializeToString()


_DAMAGES: tuple[Callable[[sensorsim_pb2.RGBRenderRequest, np.random.Generator], Damage], ...] = (
    _send_noise,
    _change_bytes,
    _cut_or_repeat,
    _change_values,
    _change_batch,
)


def _choose_method(rng: np.random.Generator) -> str:
    methods = sorted(REQUEST_TYPES)
    return methods[int(rng.integers(len(methods)))]


def _with_changed_values(
    good: sensorsim_pb2.RGBRenderRequest, rng: np.random.Generator
) -> sensorsim_pb2.RGBRenderRequest:
    request = sensorsim_pb2.RGBRenderRequest()
    request.CopyFrom(good)
    for _ in range(int(rng.integers(1, 5))):
        _change_one(request, rng)
    return request


def _change_one(message: Message, rng: np.random.Generator) -> None:
    """Changes one value of a message or of those in it."""
    fields = message.DESCRIPTOR.fields
    field = fields[int(rng.integers(len(fields)))]
    if rng.random() < 0.1:
        message.ClearField(field.name)
    elif field.is_repeated:
        values = getattr(message, field.name)
        for _ in range(int(rng.integers(1, 12))):
            if field.type == FieldDescriptor.TYPE_MESSAGE:
                _change_one(values.add(), rng)
            else:
                values.append(_draw_value(field, rng))
    elif field.type == FieldDescriptor.TYPE_MESSAGE:
        # Marked as there, also where nothing in it is set.
        getattr(message, field.name).SetInParent()
        if field.message_type.fields:
            _change_one(getattr(message, field.name), rng)
    else:
        setattr(message, field.name, _draw_value(field, rng))


def _draw_value(field: FieldDescriptor, rng: np.random.Generator) -> float | int | str | bytes | bool:
    if field.type in _FLOAT_TYPES:
        return _NUMBERS[int(rng.integers(len(_NUMBERS)))]
    if field.type == FieldDescriptor.TYPE_STRING:
        return _TEXTS[int(rng.integers(len(_TEXTS)))]
    if field.type == FieldDescriptor.TYPE_BYTES:
        return rng.bytes(8)
    if field.type == FieldDescriptor.TYPE_BOOL:
        return bool(rng.integers(2))
    if field.type == FieldDescriptor.TYPE_ENUM:
        return int(rng.integers(0, 12))
    integers = _LARGE_INTEGERS if field.type in _LARGE_TYPES else _INTEGERS
    return integers[int(rng.integers(len(integers)))]


def grpc_fuzz_claims(rows: Sequence[Row]) -> Iterator[Claim]:
    """Claims that no damaged request brings out a fault of the service.

    Args:
        rows: see :func:`measure_grpc_fuzz`.
    """
    sent = sum(int(row["requests"]) for row in rows)
    faults = sum(int(row["faults"]) + (not row["answered"]) for row in rows)
    note = f"{sent} damaged requests of five kinds over gRPC"
    yield claim("exchange.grpc_fuzz", faults if rows else None, "<=", 0, "faults", note, n=sent)


def grpc_fuzz_table(rows: Sequence[Row]) -> Iterator[str]:
    """Gives a line for each status.

    Args:
        rows: see :func:`measure_grpc_fuzz`.
    """
    yield "| log | status | answers |"
    yield "|---|---|---|"
    for row in rows:
        for status, count in row["statuses"].items():
            yield f"| {row['log']} | {status} | {count} |"
