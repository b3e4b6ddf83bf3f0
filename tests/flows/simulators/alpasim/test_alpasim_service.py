"""The sensor service over the wire: facts, images and their traffic, batches, masks, formats."""

from __future__ import annotations

import io
import itertools
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from PIL import Image
from typer.testing import CliRunner

from flows.cli.main import app
from flows.simulators.alpasim import sensorsim_pb2
from flows.simulators.alpasim.image_requests import read_image_request
from flows.simulators.alpasim.served_scene import ServedScene
from flows.simulators.alpasim.wire_poses import read_pose, write_pose
from genre_tasks.logs.types import RollingShutter
from genre_tasks.render import render_views
from genre_tasks.rollout.rig import RolloutView
from genre_tasks.scene.graph import SceneGraph
from genre_tasks.scene.transforms import compose_se3
from storage.codecs.png import to_pixels
from tests.flows.simulators.alpasim.wire_client import ServedRun, WireClient, decode, place_object, pose_pair


def distance(a: NDArray[np.uint8], b: NDArray[np.uint8]) -> int:
    """Largest difference of a channel, of 255."""
    return int(np.abs(a.astype(int) - b.astype(int)).max())


def test_the_scene_is_named_and_loaded(client: WireClient, served: ServedRun) -> None:
    assert client.scene_id == served.renderer.name
    loaded = client.call("get_loaded_scenes")
    assert [entry.scene_id for entry in loaded.scenes] == [client.scene_id]
    assert loaded.loaded_instance_capacity == 1


def test_versions_are_stated(client: WireClient) -> None:
    version = client.call("get_version")
    assert version.version_id.startswith("genre ")
    assert version.grpc_api_version.minor == 54


def test_cameras_have_lens_name_and_place(client: WireClient, served: ServedRun) -> None:
    assert [camera.logical_id for camera in client.cameras] == list(served.renderer.cameras)
    for camera, expected in zip(client.cameras, served.renderer.cameras.values(), strict=True):
        assert camera.intrinsics.logical_id == camera.logical_id
        assert camera.intrinsics.opencv_pinhole_param.focal_length_x == pytest.approx(expected.lens.fx_px)
        assert len(camera.intrinsics.opencv_pinhole_param.radial_coeffs) == 6
        height = camera.rig_to_camera.vec.z
        # Over the ground that the rig stands on.
        assert 1.0 < height < 2.5


def test_the_path_is_near_the_origin_and_on_the_ground(client: WireClient, served: ServedRun) -> None:
    times_s, world_SE3_ego = served.renderer.ego_trajectory()
    assert [pose.timestamp_us for pose in client.path] == [round(time_s * 1e6) for time_s in times_s]
    rig = np.stack([read_pose(pose.pose, "the rig") for pose in client.path])
    assert np.abs(rig[0, :3, 3]).max() < 1e-4
    moved = np.linalg.norm(np.diff(rig[:, :3, 3], axis=0), axis=1)
    expected = np.linalg.norm(np.diff((world_SE3_ego @ served.frame.ego_SE3_rig)[:, :3, 3], axis=0), axis=1)
    assert moved == pytest.approx(expected, abs=1e-4)


@pytest.mark.parametrize("chunk", [0, 1])
def test_images_are_those_of_the_library(client: WireClient, served: ServedRun, chunk: int) -> None:
    loaded = served.scenes.load(chunk)
    frame = loaded.chunk.frames[2]
    for k, view in enumerate(view for view in loaded.chunk.views if view.frame == frame):
        with torch.no_grad():
            expected = to_pixels(render_views(loaded.scene, [view]).color)[0]
        request = client.image_request(k)
        pose = served.frame.to_local(loaded.chunk.world_SE3_chunk @ view.chunk_SE3_camera)
        request.sensor_pose.CopyFrom(pose_pair(write_pose(pose)))
        request.frame_start_us = request.frame_end_us = round(view.timestamp_s * 1e6)
        assert distance(client.render(request), expected) <= 1


def test_images_are_those_of_genre_render(client: WireClient, served: ServedRun, tmp_path: Path) -> None:
    camera = client.cameras[1].logical_id
    frame = 8
    place = ["--chunk", "1", "--frame", str(frame), "--camera", camera, "--store", served.store]
    done = CliRunner().invoke(app, ["render", served.run, "--out", str(tmp_path / "image.png"), *place])
    assert done.exit_code == 0, done.output
    chunk = served.scenes.load(1).chunk
    (view,) = [view for view in chunk.views if (view.camera, view.frame) == (camera, frame)]
    request = client.image_request(1)
    pose = served.frame.to_local(chunk.world_SE3_chunk @ view.chunk_SE3_camera)
    request.sensor_pose.CopyFrom(pose_pair(write_pose(pose)))
    request.frame_start_us = request.frame_end_us = round(view.timestamp_s * 1e6)
    assert distance(client.render(request), decode((tmp_path / "image.png").read_bytes())) <= 1


def test_a_rolling_shutter_reads_rows_on_the_way_from_start_to_end(client: WireClient, served: ServedRun) -> None:
    loaded = served.scenes.load(0)
    view = loaded.chunk.views_with_role("source")[0]
    readout_s = 0.05
    turn_rad_s = 4.0
    shutter = RollingShutter(readout_s, velocity_m_s=(0.0, 0.0, 0.0), turn_rad_s=(0.0, turn_rad_s, 0.0))
    rolling = RolloutView(view.camera, view.frame, view.chunk_SE3_camera, view.lens, shutter)
    with torch.no_grad():
        still, expected = (to_pixels(render_views(without_actors(loaded.scene), [v]).color)[0] for v in (view, rolling))
    pose = served.frame.to_local(loaded.chunk.world_SE3_chunk @ view.chunk_SE3_camera)
    half = turn_rad_s * readout_s / 2
    request = client.image_request()
    request.sensor_pose.CopyFrom(pose_pair(write_pose(turn(pose, -half)), write_pose(turn(pose, half))))
    middle_us = round(view.timestamp_s * 1e6)
    request.frame_start_us = middle_us - round(readout_s * 5e5)
    request.frame_end_us = middle_us + round(readout_s * 5e5)
    request.camera_intrinsics.shutter_type = sensorsim_pb2.ROLLING_TOP_TO_BOTTOM
    # Any object makes the list all of the traffic, and no Gaussian is of this one.
    request.dynamic_objects.add(track_id="EGO")
    image = client.render(request)
    assert distance(image, expected) <= 1
    assert distance(image, still) > 20
    request.camera_intrinsics.shutter_type = sensorsim_pb2.GLOBAL
    assert distance(client.render(request), still) <= 1


def without_actors(scene: SceneGraph) -> SceneGraph:
    nowhere = {"frames": np.zeros(0, np.int64), "chunk_SE3_box": np.zeros((0, 4, 4))}
    return replace(scene, actors=tuple(replace(actor, **nowhere) for actor in scene.actors))


def turn(pose: NDArray[np.float64], angle_rad: float) -> NDArray[np.float64]:
    c = np.cos(angle_rad)
    s = np.sin(angle_rad)
    about_y = np.array([[c, 0.0, s], [0.0, 1.0, 0.0], [-s, 0.0, c]])
    return np.asarray(pose @ compose_se3(about_y, np.zeros(3)))


def test_actors_are_where_the_request_has_them(client: WireClient, served: ServedRun) -> None:
    request = client.image_request()
    recorded = client.render(request)
    request.dynamic_objects.add(track_id="EGO")
    empty = client.render(request)
    assert distance(recorded, empty) > 20
    del request.dynamic_objects[:]
    moment = (request.frame_start_us + request.frame_end_us) / 2e6
    for actor in served.renderer.actors():
        row = int(np.abs(actor.times_s - moment).argmin())
        pose = served.frame.to_local(actor.world_SE3_box[row])
        request.dynamic_objects.append(place_object(actor.track_id, pose))
    # All actors as recorded, but at the nearest frame.
    assert np.abs(client.render(request).astype(int) - recorded).mean() < 1.0
    lifted = served.frame.to_local(served.renderer.actors()[0].world_SE3_box[0])
    lifted[2, 3] += 50.0
    for entry in request.dynamic_objects:
        entry.pose_pair.CopyFrom(pose_pair(write_pose(lifted)))
    assert distance(client.render(request), empty) <= 1


def test_a_lens_is_scaled_to_the_image(client: WireClient) -> None:
    request = client.image_request()
    small = client.render(request)
    request.resolution_h = 2 * small.shape[0]
    request.resolution_w = 2 * small.shape[1]
    large = client.render(request)
    assert large.shape == (2 * small.shape[0], 2 * small.shape[1], 3)
    halved = large.reshape(small.shape[0], 2, small.shape[1], 2, 3).mean((1, 3))
    assert np.abs(halved - small).mean() < 4


def test_a_wide_lens_sees_what_a_pinhole_sees_and_more(client: WireClient) -> None:
    request = client.image_request()
    request.resolution_w = 128
    request.resolution_h = 72
    narrow = client.render(request)
    pinhole = request.camera_intrinsics.opencv_pinhole_param
    wide = client.image_request()
    wide.resolution_w = 384
    wide.resolution_h = 72
    # Pixels as large at the axis as those of the pinhole; 90° to each side.
    focal = pinhole.focal_length_x
    ftheta = wide.camera_intrinsics.ftheta_param
    ftheta.principal_point_x = 96.0
    ftheta.principal_point_y = pinhole.principal_point_y
    ftheta.reference_poly = sensorsim_pb2.FthetaCameraParam.PIXELDIST_TO_ANGLE
    ftheta.pixeldist_to_angle_poly[:] = [0.0, 1 / focal]
    wide.camera_intrinsics.resolution_w = 192
    image = client.render(wide)
    assert image.shape == (72, 384, 3)
    # Around the axis both lenses are the same: half of a pixel's angle of 10° is lost.
    around = narrow[26:46, 56:74].astype(int)
    axis = round(2 * pinhole.principal_point_x)
    same = image[26:46, 192 + 56 - axis : 192 + 74 - axis]
    assert np.abs(around - same).mean() < 6
    # And the scene goes on at its sides, to 90° on the left and the right.
    assert (image.max((0, 2)) > 60).all()
    assert image[:, :60].std() > 5
    assert image[:, -60:].std() > 5


def test_pinholes_of_a_wide_lens_have_their_part_of_the_readout(client: WireClient, served: ServedRun) -> None:
    wide = client.image_request()
    fisheye = wide.camera_intrinsics.opencv_fisheye_param
    fisheye.focal_length_x = fisheye.focal_length_y = 18.0
    fisheye.principal_point_x = 32.0
    fisheye.principal_point_y = 18.0
    wide.camera_intrinsics.shutter_type = sensorsim_pb2.ROLLING_TOP_TO_BOTTOM
    pose = read_pose(wide.sensor_pose.start_pose, "the camera")
    wide.sensor_pose.end_pose.CopyFrom(write_pose(turn(pose, 0.3)))
    wide.dynamic_objects.add(track_id="car-0", pose_pair=wide.sensor_pose)
    read = read_image_request(wide, ServedScene(served.renderer, served.frame))
    assert read.cover is not None
    assert len(read.requests) == len(read.cover.tiles) == 5
    start_s = wide.frame_start_us / 1e6
    for request, tile in zip(read.requests, read.cover.tiles, strict=True):
        assert request.start_s - start_s == pytest.approx(0.01 * tile.first_row, abs=1e-6)
        assert request.end_s - start_s == pytest.approx(0.01 * tile.last_row, abs=1e-6)
        poses = (request.start_world_SE3_camera, request.end_world_SE3_camera)
        for matrix, part in zip(poses, (tile.first_row, tile.last_row), strict=True):
            expected = turn(pose, 0.3 * part)[:3, :3] @ tile.lens_R_tile
            assert matrix[:3, :3] == pytest.approx(expected, abs=1e-5)
        (actor,) = request.actors or ()
        moved = served.frame.to_local(actor.end_world_SE3_box)
        assert moved == pytest.approx(turn(pose, 0.3 * tile.last_row), abs=1e-5)
    # The pinholes that look up and down see the upper and the lower rows alone.
    spans = [(round(tile.first_row, 2), round(tile.last_row, 2)) for tile in read.cover.tiles]
    assert spans[0] == (0.11, 0.89)
    assert spans[3][0] == 0.0 and spans[3][1] < 0.4
    assert spans[4][0] > 0.6 and spans[4][1] == 1.0


def test_jpeg_has_the_quality_that_is_asked_for(client: WireClient) -> None:
    request = client.image_request()
    png = client.render(request)
    request.image_format = sensorsim_pb2.JPEG
    sizes = {}
    for quality in (10.0, 95.0, 0.0):
        request.image_quality = quality
        encoded = client.call("render_rgb", request).image_bytes
        sizes[quality] = len(encoded)
        with Image.open(io.BytesIO(encoded)) as image:
            assert image.format == "JPEG"
    assert sizes[10.0] < sizes[95.0] == sizes[0.0]
    assert np.abs(decode(encoded).astype(int) - png).mean() < 6


def test_the_ego_mask_is_painted_where_it_is_asked_for(client: WireClient, served: ServedRun) -> None:
    (mask_id, *_) = [entry.ego_mask_id for entry in client.call("get_available_ego_masks").ego_mask_metadata]
    assert mask_id.camera_logical_id == client.cameras[0].logical_id
    request = client.image_request()
    bare = client.render(request)
    request.insert_ego_mask = True
    request.ego_mask_id.CopyFrom(mask_id)
    masked = client.render(request)
    mask = served.renderer.ego_mask(mask_id.camera_logical_id)
    assert mask is not None
    assert masked[mask].max() == 0
    assert (masked[~mask] == bare[~mask]).all()
    request.ego_mask_id.rig_config_id = "another"
    code, details = client.status("render_rgb", request.SerializeToString())
    assert (code, "ego mask" in details) == ("INVALID_ARGUMENT", True)


def test_a_batch_has_an_answer_for_each_camera(client: WireClient) -> None:
    batch = sensorsim_pb2.BatchRGBRenderRequest()
    for k in range(2):
        batch.items.add(camera_name=client.cameras[k].logical_id, request=client.image_request(k))
    batch.items.add(camera_name="unknown model").request.CopyFrom(client.image_request())
    batch.items[2].request.camera_intrinsics.ftheta_param.max_angle = 1.0
    batch.items.add(camera_name="too early").request.CopyFrom(client.image_request())
    batch.items[3].request.frame_start_us -= 3_600_000_000
    batch.items[3].request.frame_end_us -= 3_600_000_000
    answer = client.call("batch_render_rgb", batch)
    assert [item.camera_name for item in answer.items] == [item.camera_name for item in batch.items]
    assert [item.success for item in answer.items] == [True, True, False, False]
    assert "f-theta" in answer.items[2].error_message
    assert "outside of the run" in answer.items[3].error_message
    for k in range(2):
        assert distance(decode(answer.items[k].result.image_bytes), client.render(client.image_request(k))) == 0


def test_a_short_rollout_shows_driving(client: WireClient) -> None:
    images = [client.render(client.image_request(0, step)) for step in range(len(client.path))]
    assert min(distance(a, b) for a, b in itertools.pairwise(images)) > 5
