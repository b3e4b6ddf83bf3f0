"""A client of NeuroNCAP's protocol that can send nonsense, for :mod:`benchmarks.exchange.service_fuzz`."""

from __future__ import annotations

import http.client
import json
from collections.abc import Mapping, Sequence
from typing import Any
from urllib.parse import urlsplit

import numpy as np

from benchmarks.common.bench import NotMeasuredError
from benchmarks.exchange.service_fuzz import Answer
from flows.simulators.neuroncap_messages import describe_recorded, write_trajectories
from flows.simulators.scene_renderer import SceneRenderer

_TIMEOUT_S = 60
_FIRST_REFUSAL = 400
_FIRST_FAULT = 500
_BUSY = 503
_NESTED = "[" * 3000 + "]" * 3000
# As JSON texts, since some of them are none that Python would write.
_ODD_VALUES = (
    *("null", "true", "-1", "0", "1e308", "1e999", "-1e999", "NaN", "Infinity", "9223372036854775808", "1.5", '""'),
    *('"\\ud800"', '"..\\/..\\/etc"', '"raw"', "[]", "{}", "[[]]", '"' + "x" * 5000 + '"', "9" * 5000, _NESTED),
)


class NeuroncapClient:
    """Sends requests to a running service; a ``FuzzClient``.

    Args:
        address: of the service.
        renderer: of the run that it serves, for valid messages.
    """

    protocol = "neuroncap"

    def __init__(self, address: str, renderer: SceneRenderer) -> None:
        self._place = urlsplit(address)
        self._connection = self._connect()
        times_s, poses = renderer.ego_trajectory()
        images = []
        for name, camera in renderer.cameras.items():
            for image_format, row in (("png", 0), ("jpg", -1), ("raw", 1)):
                message = {
                    "pose": (poses[row] @ camera.rig_SE3_camera).tolist(),
                    "timestamp": round(float(times_s[row]) * 1e6),
                    "camera_name": name,
                    "image_format": image_format,
                }
                images.append(json.dumps(message).encode())
        actors = write_trajectories(describe_recorded(renderer.actors(), renderer.frame_s))
        self._samples: Mapping[str, Sequence[bytes]] = {
            "POST /render_image": images,
            "POST /update_actors": [json.dumps(actors).encode(), json.dumps(actors[:1]).encode(), b"[]"],
            "GET /get_actors": [b""],
            "GET /start_time": [b""],
            "GET /alive": [b""],
        }

    @property
    def samples(self) -> Mapping[str, Sequence[bytes]]:
        """Valid messages by method."""
        return self._samples

    def send(self, method: str, message: bytes) -> Answer:
        """See ``FuzzClient``.

        Args:
            method: verb and path.
            message: the body.
        """
        verb, path = method.split(" ")
        try:
            status, content = self._request(verb, path, message)
        except (OSError, http.client.HTTPException) as error:
            self._connection.close()
            self._connection = self._connect()
            return Answer("connection lost", is_fault=True, detail=repr(error))
        is_refusal = status >= _FIRST_REFUSAL
        detail = content[:500].decode("utf-8", "replace") if is_refusal else ""
        is_fault = status >= _FIRST_FAULT and status != _BUSY
        return Answer(str(status), is_fault, detail, is_refusal)

    def fetch_image(self, message: bytes) -> bytes:
        """Asks for an image.

        Args:
            message: a valid request.

        Returns:
            The encoded image.

        Raises:
            NotMeasuredError: the service refuses it.
        """
        status, content = self._request("POST", "/render_image", message)
        if status >= _FIRST_REFUSAL:
            raise NotMeasuredError(f"the service answers {status}: {content[:200]!r}")
        return content

    def mutate_fields(self, message: bytes, random: np.random.Generator) -> bytes:
        """See ``FuzzClient``.

        Args:
            message: valid JSON, or nothing.
            random: chooses.
        """
        if not message:
            return message
        marks: dict[str, str] = {}
        value = json.loads(message)
        for _ in range(int(random.integers(1, 4))):
            value = _mutate(value, random, marks)
        text = json.dumps(value)
        for mark, odd in marks.items():
            text = text.replace(f'"{mark}"', odd)
        return text.encode()

    def is_alive(self) -> bool:
        """See ``FuzzClient``."""
        self.send("POST /update_actors", self._samples["POST /update_actors"][0])
        return self.send("POST /render_image", self._samples["POST /render_image"][0]).status == "200"

    def _connect(self) -> http.client.HTTPConnection:
        return http.client.HTTPConnection(self._place.hostname or "", self._place.port, timeout=_TIMEOUT_S)

    def _request(self, verb: str, path: str, message: bytes) -> tuple[int, bytes]:
        self._connection.request(verb, path, body=message)
        response = self._connection.getresponse()
        return response.status, response.read()


def _mutate(value: Any, random: np.random.Generator, marks: dict[str, str]) -> Any:
    """A copy of a JSON value with one part replaced, left out or repeated."""
    # Deeper with each level, so that single numbers of poses are met as often as the poses themselves.
    if isinstance(value, list) and value and random.random() < 0.8:
        index = int(random.integers(len(value)))
        kind = random.random()
        if kind < 0.1:
            return value[:index] + value[index + 1 :]
        if kind < 0.2:
            return value[: index + 1] + value[index:]
        return [*value[:index], _mutate(value[index], random, marks), *value[index + 1 :]]
    if isinstance(value, dict) and value and random.random() < 0.9:
        name = str(random.choice(list(value)))
        if random.random() < 0.1:
            return {key: part for key, part in value.items() if key != name}
        return value | {name: _mutate(value[name], random, marks)}
    if isinstance(value, float | int) and random.random() < 0.4:
        return value * float(random.choice([-1.0, 0.5, 1.0001, 1e3, 1e9]))
    mark = f"mark-{len(marks)}-{int(random.integers(2**31))}"
    marks[mark] = str(random.choice(np.array(_ODD_VALUES, object)))
    return mark
