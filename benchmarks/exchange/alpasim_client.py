"""A client of the sensor service that can send nonsense, for :mod:`benchmarks.exchange.service_fuzz`."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import grpc
import numpy as np
from google.protobuf.descriptor import FieldDescriptor
from google.protobuf.message import Message

from benchmarks.exchange.service_fuzz import Answer
from benchmarks.exchange.simulator_client import Simulator, make_plain_request
from flows.simulators.alpasim import sensorsim_pb2
from flows.simulators.alpasim.server import REQUEST_TYPES, SERVICE

_TIMEOUT_S = 60
_IMAGE_PX = (64, 40)
_REFUSALS = frozenset({"INVALID_ARGUMENT", "UNIMPLEMENTED", "RESOURCE_EXHAUSTED", "OUT_OF_RANGE"})
"""Statuses that say what is wrong with a request. Any other one says that the service has a fault."""

_NUMBERS = (0.0, -1.0, 1.0, 0.5, 1e-30, 1e6, -1e6, 1e30, math.inf, -math.inf, math.nan)
_INTEGERS = (0, 1, 2, 5, 64, 77, 1 << 15, (1 << 31) - 1, (1 << 32) - 1)
_LARGE_INTEGERS = (*_INTEGERS, 1 << 40, (1 << 63) - 1, (1 << 64) - 1)
_TEXTS = ("", "EGO", "car-0", "car-1", "../x", "\x00", "ü" * 300, "1" * 5000)
_FLOAT_TYPES = (FieldDescriptor.TYPE_DOUBLE, FieldDescriptor.TYPE_FLOAT)
_LARGE_TYPES = (FieldDescriptor.TYPE_FIXED64, FieldDescriptor.TYPE_UINT64)
_MOST_CHANGES = 5
_MOST_VALUES = 12
_CLEARED_PART = 0.1
_ENUM_VALUES = 12


class AlpasimClient:
    """Sends requests to a running service; a ``FuzzClient``.

    Args:
        address: of the service.
    """

    protocol = "alpasim"

    def __init__(self, address: str) -> None:
        self._simulator = Simulator.connect(address)
        good = make_plain_request(self._simulator, _IMAGE_PX)
        pair = good.sensor_pose
        crowded = sensorsim_pb2.RGBRenderRequest()
        crowded.CopyFrom(good)
        for name in ("car-0", "EGO"):
            crowded.dynamic_objects.add(track_id=name, pose_pair=pair)
        batch = sensorsim_pb2.BatchRGBRenderRequest()
        for name, request in (("front", good), ("left", crowded)):
            batch.items.add(camera_name=name, request=request)
        scene = sensorsim_pb2.AvailableCamerasRequest(scene_id=self._simulator.scene_id).SerializeToString()
        lidar = sensorsim_pb2.LidarRenderRequest(scene_id=self._simulator.scene_id, sensor_pose=pair)
        aggregated = sensorsim_pb2.AggregatedRenderRequest(rgb_requests=[good], lidar_requests=[lidar])
        self._good = good.SerializeToString()
        messages = {
            "render_rgb": [self._good, crowded.SerializeToString()],
            "batch_render_rgb": [batch.SerializeToString()],
            "render_lidar": [lidar.SerializeToString()],
            "render_aggregated": [aggregated.SerializeToString()],
            "get_available_cameras": [scene],
            "get_available_trajectories": [scene],
        }
        self._samples: Mapping[str, Sequence[bytes]] = {name: messages.get(name, [b""]) for name in REQUEST_TYPES}

    @property
    def samples(self) -> Mapping[str, Sequence[bytes]]:
        """Valid messages by method."""
        return self._samples

    def send(self, method: str, message: bytes) -> Answer:
        """See ``FuzzClient``."""
        try:
            self._simulator.channel.unary_unary(f"/{SERVICE}/{method}")(message, timeout=_TIMEOUT_S)
        except grpc.RpcError as error:
            status = str(error.code().name)
            refused = status in _REFUSALS
            return Answer(status, is_fault=not refused, detail=str(error.details() or ""), is_refusal=refused)
        return Answer("OK", is_fault=False)

    def mutate_fields(self, message: bytes, random: np.random.Generator) -> bytes:
        """See ``FuzzClient``; the message's type is that of the method whose sample it is."""
        method = next(name for name, samples in self._samples.items() if message in samples)
        changed = REQUEST_TYPES[method].FromString(message)
        for _ in range(int(random.integers(1, _MOST_CHANGES))):
            _change_one(changed, random)
        return changed.SerializeToString()

    def is_alive(self) -> bool:
        """See ``FuzzClient``."""
        return self.send("render_rgb", self._good).status == "OK"

    def close(self) -> None:
        """Ends the connection."""
        self._simulator.channel.close()


def _change_one(message: Message, random: np.random.Generator) -> None:
    """Changes one value of a message or of those in it."""
    fields = message.DESCRIPTOR.fields
    if not fields:
        return
    field = fields[int(random.integers(len(fields)))]
    if random.random() < _CLEARED_PART:
        message.ClearField(field.name)
    elif field.is_repeated:
        _change_repeated(message, field, random)
    elif field.type == FieldDescriptor.TYPE_MESSAGE:
        # Marked as there, also where nothing in it is set.
        getattr(message, field.name).SetInParent()
        _change_one(getattr(message, field.name), random)
    else:
        setattr(message, field.name, _draw_value(field, random))


def _change_repeated(message: Message, field: FieldDescriptor, random: np.random.Generator) -> None:
    values = getattr(message, field.name)
    # Half of the time those that are there already are changed, if they are messages.
    if field.type == FieldDescriptor.TYPE_MESSAGE and len(values) and random.random() < 0.5:
        _change_one(values[int(random.integers(len(values)))], random)
        return
    for _ in range(int(random.integers(1, _MOST_VALUES))):
        if field.type == FieldDescriptor.TYPE_MESSAGE:
            _change_one(values.add(), random)
        else:
            values.append(_draw_value(field, random))


def _draw_value(field: FieldDescriptor, random: np.random.Generator) -> float | int | str | bytes | bool:
    if field.type in _FLOAT_TYPES:
        return _NUMBERS[int(random.integers(len(_NUMBERS)))]
    if field.type == FieldDescriptor.TYPE_STRING:
        return _TEXTS[int(random.integers(len(_TEXTS)))]
    if field.type == FieldDescriptor.TYPE_BYTES:
        return random.bytes(8)
    if field.type == FieldDescriptor.TYPE_BOOL:
        return bool(random.integers(2))
    if field.type == FieldDescriptor.TYPE_ENUM:
        return int(random.integers(_ENUM_VALUES))
    integers = _LARGE_INTEGERS if field.type in _LARGE_TYPES else _INTEGERS
    return integers[int(random.integers(len(integers)))]
