"""What no image can be rendered of gets a status code and a sentence, whatever it is, and the service goes on."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from math import inf, nan

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from flows.simulators.alpasim import sensorsim_pb2
from flows.simulators.alpasim.server import MAX_REQUEST_BYTES, REQUEST_TYPES
from tests.flows.simulators.alpasim.wire_bytes import block, fixed64, varint
from tests.flows.simulators.alpasim.wire_client import WireClient

Request = sensorsim_pb2.RGBRenderRequest
QUICK = settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])


def change(name: str, value: object) -> Callable[[Request], None]:
    """Sets one value of a request: ``a.b.c``."""

    def apply(request: Request) -> None:
        *path, last = name.split(".")
        target = request
        for part in path:
            target = getattr(target, part)
        if isinstance(value, list):
            getattr(target, last)[:] = value
        else:
            setattr(target, last, value)

    return apply


def clear(name: str) -> Callable[[Request], None]:
    return lambda request: request.ClearField(name)


def choose_fisheye(request: Request, focal_px: float) -> None:
    fisheye = request.camera_intrinsics.opencv_fisheye_param
    fisheye.focal_length_x = fisheye.focal_length_y = focal_px
    fisheye.principal_point_x = 32.0
    fisheye.principal_point_y = 18.0


def choose_ftheta(request: Request, *coefficients: float) -> None:
    request.camera_intrinsics.ftheta_param.angle_to_pixeldist_poly[:] = coefficients


def add_windshield(request: Request) -> None:
    request.camera_intrinsics.bivariate_windshield_model_param.horizontal_poly[:] = [1.0]


def shut_from_below(request: Request) -> None:
    request.camera_intrinsics.shutter_type = sensorsim_pb2.ROLLING_BOTTOM_TO_TOP
    request.sensor_pose.end_pose.vec.x += 1.0


def add_objects(request: Request, count: int) -> None:
    for _ in range(count):
        request.dynamic_objects.add(track_id="car-0").pose_pair.CopyFrom(request.sensor_pose)


def add_unposed(request: Request) -> None:
    request.dynamic_objects.add(track_id="car-0")


PINHOLE = "camera_intrinsics.opencv_pinhole_param"
REFUSED = {
    "another scene": (change("scene_id", "another"), "INVALID_ARGUMENT", "no scene 'another'"),
    "no scene": (clear("scene_id"), "INVALID_ARGUMENT", "no scene"),
    "no camera": (clear("camera_intrinsics"), "INVALID_ARGUMENT", "camera model"),
    "looks backwards": (partial(choose_fisheye, focal_px=12.0), "UNIMPLEMENTED", "from its axis"),
    "flat fisheye": (partial(choose_fisheye, focal_px=0.0), "INVALID_ARGUMENT", "onto a line"),
    "endless fisheye": (partial(choose_fisheye, focal_px=inf), "INVALID_ARGUMENT", "scales"),
    "no polynomial": (choose_ftheta, "INVALID_ARGUMENT", "no polynomial"),
    "falling": (lambda request: choose_ftheta(request, 0.0, -30.0), "INVALID_ARGUMENT", "does not rise"),
    "too sharp": (lambda request: choose_ftheta(request, 0.0, 1e5), "INVALID_ARGUMENT", "focal length fx"),
    "windshield": (add_windshield, "UNIMPLEMENTED", "windshield"),
    "rational": (change(f"{PINHOLE}.radial_coeffs", [0, 0, 0, 0.1]), "UNIMPLEMENTED", "k4"),
    "thin prism": (change(f"{PINHOLE}.thin_prism_coeffs", [0.1]), "UNIMPLEMENTED", "thin prism"),
    "seven coefficients": (change(f"{PINHOLE}.radial_coeffs", [0.0] * 7), "INVALID_ARGUMENT", "at most 6"),
    "infinite coefficient": (change(f"{PINHOLE}.tangential_coeffs", [inf]), "INVALID_ARGUMENT", "tangential"),
    "folding lens": (change(f"{PINHOLE}.radial_coeffs", [-5000.0]), "INVALID_ARGUMENT", "folds back"),
    "no focal length": (change(f"{PINHOLE}.focal_length_x", 0.0), "INVALID_ARGUMENT", "focal"),
    "negative focal length": (change(f"{PINHOLE}.focal_length_y", -5.0), "INVALID_ARGUMENT", "focal"),
    "endless focal length": (change(f"{PINHOLE}.focal_length_y", inf), "INVALID_ARGUMENT", "focal"),
    "absurd center": (change(f"{PINHOLE}.principal_point_x", 1e30), "INVALID_ARGUMENT", "principal point"),
    "absurd lens": (change("camera_intrinsics.resolution_w", 4_000_000_000), "INVALID_ARGUMENT", "absurd"),
    "huge image": (change("resolution_h", 4_000_000_000), "INVALID_ARGUMENT", "out of bounds"),
    "large image": (change("resolution_w", 16_000), "INVALID_ARGUMENT", "out of bounds"),
    "no pose": (clear("sensor_pose"), "INVALID_ARGUMENT", "sensor pose"),
    "no number": (change("sensor_pose.start_pose.vec.x", nan), "INVALID_ARGUMENT", "not finite"),
    "no quaternion": (change("sensor_pose.start_pose.quat.w", 9.0), "INVALID_ARGUMENT", "unit quaternion"),
    "far away": (change("sensor_pose.end_pose.vec.y", 1e20), "INVALID_ARGUMENT", "origin"),
    "20 km away": (change("sensor_pose.start_pose.vec.y", 2e4), "INVALID_ARGUMENT", "within one image"),
    "ends before": (change("frame_end_us", 1), "INVALID_ARGUMENT", "before it starts"),
    "another day": (change("frame_start_us", 1), "INVALID_ARGUMENT", "outside of the run"),
    "far future": (change("frame_end_us", 2**64 - 1), "INVALID_ARGUMENT", "outside of the run"),
    "from below": (shut_from_below, "UNIMPLEMENTED", "shutter"),
    "no format": (clear("image_format"), "INVALID_ARGUMENT", "image format"),
    "film": (change("image_format", sensorsim_pb2.AV1), "UNIMPLEMENTED", "image format"),
    "unknown format": (change("image_format", 77), "UNIMPLEMENTED", "image format"),
    "too good": (change("image_quality", 101.0), "INVALID_ARGUMENT", "quality"),
    "no quality": (change("image_quality", nan), "INVALID_ARGUMENT", "quality"),
    "unposed object": (add_unposed, "INVALID_ARGUMENT", "object 'car-0'"),
    "twice": (partial(add_objects, count=2), "INVALID_ARGUMENT", "twice"),
    "crowd": (partial(add_objects, count=5000), "INVALID_ARGUMENT", "too many"),
}


@pytest.mark.parametrize("case", REFUSED)
def test_a_request_without_an_image_is_refused(client: WireClient, case: str) -> None:
    apply, code, words = REFUSED[case]
    assert words
    request = client.image_request()
    apply(request)
    found, details = client.status("render_rgb", request.SerializeToString())
    assert (found, words in details) == (code, True), details
    assert len(details) < 600
    batch = sensorsim_pb2.BatchRGBRenderRequest()
    batch.items.add(camera_name="bad", request=request)
    batch.items.add(camera_name="good", request=client.image_request())
    bad, good = client.call("batch_render_rgb", batch).items
    assert (bad.success, bad.error_message, good.success) == (False, details, True)


def test_a_batch_of_too_many_images_is_refused(client: WireClient) -> None:
    batch = sensorsim_pb2.BatchRGBRenderRequest()
    for _ in range(1000):
        batch.items.add(camera_name="front")
    code, details = client.status("batch_render_rgb", batch.SerializeToString())
    assert (code, "too many for one call" in details) == ("INVALID_ARGUMENT", True), details


def test_lidar_and_all_sensors_at_once_are_not_there(client: WireClient) -> None:
    for method in ("render_lidar", "render_aggregated"):
        code, details = client.status(method, b"")
        assert (code, bool(details)) == ("UNIMPLEMENTED", True)
    assert client.status("no_such_method", b"")[0] == "UNIMPLEMENTED"


def test_a_large_message_is_read_and_refused_for_what_is_in_it(client: WireClient) -> None:
    # A million objects without a name, in as few bytes as that takes.
    payload = client.image_request().SerializeToString() + block(8, b"") * 1_000_000
    code, details = client.status("render_rgb", payload)
    assert (code, "1000000 objects are too many" in details) == ("INVALID_ARGUMENT", True)


def test_an_oversized_message_is_refused(client: WireClient) -> None:
    payload = block(1, bytes(MAX_REQUEST_BYTES))
    assert client.status("render_rgb", payload)[0] == "RESOURCE_EXHAUSTED"
    assert client.status("get_version", b"")[0] == "OK"


@pytest.mark.parametrize(
    "payload",
    [
        b"\xff\xff\xff",
        block(1, b"\xff\xfe"),  # no UTF-8
        b"\x0a" + varint(1 << 40),  # claims a terabyte
        b"\x0b" * 200,  # groups without end
        fixed64(1, 5),  # a number where the name of a scene is
        block(4, block(3, block(5, b"1234567"))),  # doubles of seven bytes
    ],
)
def test_bytes_that_are_no_message_are_refused(client: WireClient, payload: bytes) -> None:
    assert client.status("render_rgb", payload)[0] == "INVALID_ARGUMENT"


@QUICK
@given(method=st.sampled_from(sorted(REQUEST_TYPES)), payload=st.binary(max_size=300))
def test_random_bytes_get_a_status(client: WireClient, method: str, payload: bytes) -> None:
    assert client.status(method, payload)[0] in ("OK", "INVALID_ARGUMENT", "UNIMPLEMENTED")


@QUICK
@given(seed=st.integers(0, 2**32 - 1))
def test_damaged_requests_get_a_status(client: WireClient, seed: int) -> None:
    rng = np.random.default_rng(seed)
    payload = bytearray(client.image_request().SerializeToString())
    for place in rng.integers(0, len(payload), rng.integers(1, 6)):
        payload[place] = rng.integers(0, 256)
    cut = payload[: rng.integers(0, len(payload) + 1)] if seed % 3 == 0 else payload
    assert client.status("render_rgb", bytes(cut))[0] in ("OK", "INVALID_ARGUMENT", "UNIMPLEMENTED")
