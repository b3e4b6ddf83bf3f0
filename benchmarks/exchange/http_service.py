"""Images over HTTP and steps of the driving environment: how fast they come, and whether they are the library's."""

from __future__ import annotations

import io
import json
import time
from collections.abc import Iterator

import numpy as np
import torch
from PIL import Image

from benchmarks.common.bench import Row
from benchmarks.common.context import THREADS
from benchmarks.common.timing import Quartiles
from benchmarks.exchange.neuroncap_client import NeuroncapClient
from flows.simulators.driving_env import GenreDrivingEnv
from flows.simulators.image_request import ImageRequest
from flows.simulators.neuroncap import start_neuroncap
from flows.simulators.scene_renderer import SceneRenderer
from flows.simulators.service import ServiceRequest
from flows.simulators.service_metrics import SilentMetrics

IMAGES = 60
STEPS = 15
_RELIABLE_M = 4.0


def measure_http_service(store: str, run: str, images: int = IMAGES) -> Row:
    """Asks a NeuroNCAP service for images at recorded poses, and the library for the same ones.

    Args:
        store: folder of the store.
        run: the run's name, or the start of it.
        images: how many.

    Returns:
        Milliseconds of an image by HTTP and by the library, as quartiles, and the largest difference of 255.
    """
    torch.set_num_threads(THREADS)
    renderer = SceneRenderer(store, run)
    service = start_neuroncap(ServiceRequest({renderer.name: renderer}, "127.0.0.1", 0, SilentMetrics()))
    client = NeuroncapClient(service.address, renderer)
    http_ms = []
    library_ms = []
    differences = []
    # Three more, which load code and scenes.
    for k, request in enumerate(_list_requests(renderer, images + 3)):
        message = {
            "pose": request.start_world_SE3_camera.tolist(),
            "timestamp": round(request.start_s * 1e6),
            "camera_name": request.camera,
            "image_format": "png",
        }
        begin = time.perf_counter()
        content = client.fetch_image(json.dumps(message).encode())
        middle = time.perf_counter()
        expected = renderer.render(request)
        end = time.perf_counter()
        got = np.asarray(Image.open(io.BytesIO(content)))
        differences.append(int(np.abs(got.astype(int) - expected).max()))
        if k >= 3:
            http_ms.append(1e3 * (middle - begin))
            library_ms.append(1e3 * (end - middle))
    service.close()
    lens = next(iter(renderer.cameras.values())).lens
    return {
        "run": renderer.name,
        "images": images,
        "size_px": [lens.width_px, lens.height_px],
        "http_ms": Quartiles.from_values(http_ms).as_row(),
        "library_ms": Quartiles.from_values(library_ms).as_row(),
        "max_difference": max(differences),
    }


def measure_driving(store: str, run: str, steps: int = STEPS) -> Row:
    """Drives straight on in the environment, with all cameras of the rig.

    Args:
        store: folder of the store.
        run: the run's name, or the start of it.
        steps: at most so many.

    Returns:
        Steps a second, as quartiles, and the number of cameras.
    """
    torch.set_num_threads(THREADS)
    env = GenreDrivingEnv(store, run, reliable_m=_RELIABLE_M)
    observation, _ = env.reset(seed=0)
    rates = []
    for _ in range(steps):
        begin = time.perf_counter()
        _, _, terminated, truncated, _ = env.step(np.zeros(2, np.float32))
        rates.append(1 / (time.perf_counter() - begin))
        if terminated or truncated:
            break
    return {"run": run, "cameras": len(observation["rgb"]), "steps_per_s": Quartiles.from_values(rates).as_row()}


def _list_requests(renderer: SceneRenderer, count: int) -> Iterator[ImageRequest]:
    times_s, poses = renderer.ego_trajectory()
    cameras = list(renderer.cameras.values())
    for k in range(count):
        row = k % len(poses)
        camera = cameras[k // len(poses) % len(cameras)]
        pose = poses[row] @ camera.rig_SE3_camera
        time_s = float(times_s[row])
        yield ImageRequest(camera.lens, pose, pose, time_s, time_s, camera=camera.name)
