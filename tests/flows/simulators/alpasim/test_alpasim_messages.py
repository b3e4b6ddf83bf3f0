"""The messages have the names, numbers and bytes of the protocol."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from flows.simulators.alpasim import common_pb2, sensorsim_pb2
from flows.simulators.alpasim.server import REQUEST_TYPES, SERVICE
from tests.flows.simulators.alpasim.wire_bytes import block, double, doubles, fixed64, floating, integer, pose

ROOT = Path(__file__).resolve().parents[4]
FOLDER = "flows/simulators/alpasim"
PROTOS = (f"{FOLDER}/common.proto", f"{FOLDER}/sensorsim.proto")
PACKAGE = "nre.grpc.protos.sensorsim"

PINHOLE = block(
    3,
    double(1, 256.0)
    + double(2, 160.5)
    + double(3, 300.0)
    + double(4, 301.0)
    + doubles(5, 0.1, -0.2, 0.3, 0.0, 0.0, 0.0)
    + doubles(6, 0.01, -0.02)
    + doubles(7, 0.0, 0.0, 0.0, 0.0),
)
CAMERA = PINHOLE + block(5, "front") + integer(7, 320) + integer(8, 512) + integer(9, 1)
START = pose((1.5, -2.0, 0.0), (1.0, 0.0, 0.0, 0.0))
END = pose((1.75, -2.0, 0.25), (0.0, 0.0, 0.0, 1.0))
PAIR = block(1, START) + block(2, END)
IMAGE = (
    block(1, "scene")
    + integer(2, 320)
    + integer(3, 512)
    + block(4, CAMERA)
    + fixed64(5, 1_700_000_000_000_000)
    + fixed64(6, 1_700_000_000_030_000)
    + block(7, PAIR)
    + block(8, block(1, "car-3") + block(2, PAIR))
    + block(8, block(1, "EGO"))
    + integer(9, 2)
    + floating(10, 95.0)
    + integer(11, 1)
    + block(12, block(1, "front") + block(2, "rig"))
)
IMAGE_TEXT = """
scene_id: "scene" resolution_h: 320 resolution_w: 512
camera_intrinsics {
  opencv_pinhole_param {
    principal_point_x: 256 principal_point_y: 160.5 focal_length_x: 300 focal_length_y: 301
    radial_coeffs: [0.1, -0.2, 0.3, 0, 0, 0] tangential_coeffs: [0.01, -0.02] thin_prism_coeffs: [0, 0, 0, 0]
  }
  logical_id: "front" resolution_h: 320 resolution_w: 512 shutter_type: ROLLING_TOP_TO_BOTTOM
}
frame_start_us: 1700000000000000 frame_end_us: 1700000000030000
sensor_pose {
  start_pose { vec { x: 1.5 y: -2 } quat { w: 1 } }
  end_pose { vec { x: 1.75 y: -2 z: 0.25 } quat { z: 1 } }
}
dynamic_objects {
  track_id: "car-3"
  pose_pair {
    start_pose { vec { x: 1.5 y: -2 } quat { w: 1 } }
    end_pose { vec { x: 1.75 y: -2 z: 0.25 } quat { z: 1 } }
  }
}
dynamic_objects { track_id: "EGO" }
image_format: JPEG image_quality: 95 insert_ego_mask: true
ego_mask_id { camera_logical_id: "front" rig_config_id: "rig" }
"""

FTHETA = block(
    2,
    double(1, 959.0)
    + double(2, 543.0)
    + integer(3, 1)
    + doubles(4, 0.0, 0.001)
    + doubles(5, 0.0, 1000.0)
    + double(6, 1.25)
    + block(7, double(1, 1.0) + double(2, 0.5) + double(3, 0.25)),
)
FISHEYE = block(4, double(1, 1.0) + double(2, 2.0) + double(3, 3.0) + double(4, 4.0) + doubles(5, 0.5) + double(6, 1.5))

# Message, its bytes put together from field numbers, and the same as text for protoc.
CASES = {
    "image": (f"{PACKAGE}.RGBRenderRequest", IMAGE, IMAGE_TEXT),
    "image return": (f"{PACKAGE}.RGBRenderReturn", block(1, b"\x89PNG"), r'image_bytes: "\211PNG"'),
    "batch": (
        f"{PACKAGE}.BatchRGBRenderRequest",
        block(1, block(1, "front") + block(2, IMAGE)),
        f'items {{ camera_name: "front" request {{ {IMAGE_TEXT} }} }}',
    ),
    "batch return": (
        f"{PACKAGE}.BatchRGBRenderReturn",
        block(1, block(1, "a") + block(2, block(1, b"x")) + integer(3, 1)) + block(1, block(1, "b") + block(4, "no")),
        'items { camera_name: "a" result { image_bytes: "x" } success: true } '
        'items { camera_name: "b" error_message: "no" }',
    ),
    "f-theta": (
        f"{PACKAGE}.CameraSpec",
        FTHETA + block(5, "wide") + integer(9, 5) + block(10, integer(1, 1) + doubles(2, 2.0)),
        "ftheta_param { principal_point_x: 959 principal_point_y: 543 reference_poly: PIXELDIST_TO_ANGLE "
        "pixeldist_to_angle_poly: [0, 0.001] angle_to_pixeldist_poly: [0, 1000] max_angle: 1.25 "
        'linear_cde { linear_c: 1 linear_d: 0.5 linear_e: 0.25 } } logical_id: "wide" shutter_type: GLOBAL '
        "bivariate_windshield_model_param { reference_poly: BACKWARD horizontal_poly: 2 }",
    ),
    "fisheye": (
        f"{PACKAGE}.CameraSpec",
        FISHEYE,
        "opencv_fisheye_param { principal_point_x: 1 principal_point_y: 2 focal_length_x: 3 focal_length_y: 4 "
        "radial_coeffs: 0.5 max_angle: 1.5 }",
    ),
    "cameras": (
        f"{PACKAGE}.AvailableCamerasReturn",
        block(1, block(1, CAMERA) + block(2, START) + block(3, "front")),
        "available_cameras { intrinsics { opencv_pinhole_param { principal_point_x: 256 principal_point_y: 160.5 "
        "focal_length_x: 300 focal_length_y: 301 radial_coeffs: [0.1, -0.2, 0.3, 0, 0, 0] "
        'tangential_coeffs: [0.01, -0.02] thin_prism_coeffs: [0, 0, 0, 0] } logical_id: "front" resolution_h: 320 '
        "resolution_w: 512 shutter_type: ROLLING_TOP_TO_BOTTOM } "
        'rig_to_camera { vec { x: 1.5 y: -2 } quat { w: 1 } } logical_id: "front" }',
    ),
    "trajectories": (
        f"{PACKAGE}.AvailableTrajectoriesReturn",
        block(1, block(2, block(1, block(1, START) + fixed64(2, 7)))),
        "available_trajectories { trajectory { "
        "poses { pose { vec { x: 1.5 y: -2 } quat { w: 1 } } timestamp_us: 7 } } }",
    ),
    "ego masks": (
        f"{PACKAGE}.AvailableEgoMasksReturn",
        block(1, block(1, block(1, "front") + block(2, "rig"))),
        'ego_mask_metadata { ego_mask_id { camera_logical_id: "front" rig_config_id: "rig" } }',
    ),
    "scenes": ("common.AvailableScenesReturn", block(1, "a") + block(1, "b"), 'scene_ids: ["a", "b"]'),
    "loaded scenes": (
        f"{PACKAGE}.LoadedScenesReturn",
        block(1, block(1, "a") + integer(2, 1) + integer(3, 2)) + integer(2, 300),
        'scenes { scene_id: "a" loaded_instance_count: 1 reusable_instance_count: 2 } loaded_instance_capacity: 300',
    ),
    "version": (
        "common.VersionId",
        block(1, "v") + block(2, "g") + block(3, integer(1, 1) + integer(2, 2) + integer(3, 3)),
        'version_id: "v" git_hash: "g" grpc_api_version { major: 1 minor: 2 patch: 3 }',
    ),
    "lidar": (
        f"{PACKAGE}.LidarRenderRequest",
        block(1, "s") + block(2, integer(2, 1)) + fixed64(3, 1) + fixed64(4, 2) + block(5, PAIR) + block(6, b""),
        'scene_id: "s" lidar_config { lidar_type: AT128 } frame_start_us: 1 frame_end_us: 2 '
        "sensor_pose { start_pose { vec { x: 1.5 y: -2 } quat { w: 1 } } "
        "end_pose { vec { x: 1.75 y: -2 z: 0.25 } quat { z: 1 } } } dynamic_objects {}",
    ),
    "sweep": (
        f"{PACKAGE}.LidarRenderReturn",
        integer(3, 1) + block(4, b"abc") + block(5, b"d"),
        'num_points: 1 point_xyzs_buffer: "abc" point_intensities_buffer: "d"',
    ),
    "all sensors": (
        f"{PACKAGE}.AggregatedRenderRequest",
        block(1, block(1, "s")) + block(2, block(1, "s")),
        'rgb_requests { scene_id: "s" } lidar_requests { scene_id: "s" }',
    ),
}


def run_protoc(*options: str, stdin: bytes = b"") -> bytes:
    pytest.importorskip("grpc_tools")
    command = [sys.executable, "-m", "grpc_tools.protoc", "-I", str(ROOT), *options]
    done = subprocess.run(command, input=stdin, cwd=ROOT, capture_output=True, check=False)
    assert done.returncode == 0, done.stderr.decode()
    return done.stdout


def find_type(name: str) -> type:
    module = common_pb2 if name.startswith("common.") else sensorsim_pb2
    found: type = getattr(module, name.rpartition(".")[2])
    return found


@pytest.mark.parametrize("case", CASES)
def test_messages_read_and_write_bytes_of_the_field_numbers(case: str) -> None:
    name, expected, _ = CASES[case]
    message = find_type(name)
    assert message.DESCRIPTOR.full_name == name
    parsed = message.FromString(expected)
    # Nothing was left over as an unknown field: written again from the known ones alone, it is the same.
    parsed.DiscardUnknownFields()
    assert parsed.SerializeToString() == expected


@pytest.mark.parametrize("case", CASES)
def test_protoc_encodes_the_same_bytes(case: str) -> None:
    name, expected, text = CASES[case]
    assert run_protoc(f"--encode={name}", PROTOS[1], stdin=text.encode()) == expected


def test_generated_messages_are_those_of_the_proto_files(tmp_path: Path) -> None:
    run_protoc(f"--python_out={tmp_path}", f"--pyi_out={tmp_path}", *PROTOS)
    for stem in ("common_pb2", "sensorsim_pb2"):
        for suffix in (".py", ".pyi"):
            generated = strip_version((tmp_path / FOLDER / (stem + suffix)).read_text())
            assert generated == strip_version((ROOT / FOLDER / (stem + suffix)).read_text()), stem + suffix


def strip_version(text: str) -> str:
    """A generated module without the version of the compiler that wrote it."""
    lines = text.splitlines()
    return "\n".join(line for line in lines if not line.strip().rstrip(",").isdigit() and "Python Version" not in line)


def test_the_service_answers_all_methods_of_the_protocol() -> None:
    service = sensorsim_pb2.DESCRIPTOR.services_by_name["SensorsimService"]
    assert service.full_name == SERVICE == "nre.grpc.protos.sensorsim.SensorsimService"
    inputs = {method.name: method.input_type.full_name for method in service.methods}
    assert inputs == {name: kind.DESCRIPTOR.full_name for name, kind in REQUEST_TYPES.items()}
    assert len(inputs) == 10
