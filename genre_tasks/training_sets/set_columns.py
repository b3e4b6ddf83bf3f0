"""The columns of this project's training sets: ``images.parquet`` and ``boxes.parquet``, with their units."""

from __future__ import annotations

IMAGES_TABLE = "images.parquet"
BOXES_TABLE = "boxes.parquet"
DESCRIPTION = "training_set.json"
LAYOUT = "genre-training-set"
LAYOUT_VERSION = 1

IMAGE_COLUMNS = {
    "image": ("int64", "number of the image, which boxes refer to"),
    "file": ("string", "PNG of 8-bit sRGB, below this folder"),
    "log": ("string", "name of the log"),
    "camera": ("string", "name of the camera"),
    "frame": ("int64", "frame of the log"),
    "timestamp_s": ("double", "seconds since 1970 at which the image was taken"),
    "shift_m": ("double", "metres to the left of the recorded path; 0 on it"),
    "rendered": ("bool", "whether a scene was rendered, and not a camera's image recorded"),
    "world_SE3_camera": (
        "matrix",
        "4 x 4, row by row; takes camera to world coordinates; camera x right, y down, z on",
    ),
    "world_SE3_ego": (
        "matrix",
        "4 x 4, row by row; takes vehicle to world coordinates; vehicle x forward, y left, z up",
    ),
    "width_px": ("int64", "of the image"),
    "height_px": ("int64", "of the image"),
    "fx_px": ("double", "horizontal focal length"),
    "fy_px": ("double", "vertical focal length"),
    "cx_px": ("double", "principal point from the image's left edge; the first pixel's centre is at 0.5"),
    "cy_px": ("double", "principal point from the image's upper edge"),
    "distortion": ("numbers", "Brown-Conrady k1, k2, p1, p2, k3; empty for a lens without"),
}
"""Name → kind and meaning of a column of images."""

BOX_COLUMNS = {
    "image": ("int64", "number of the image"),
    "track_id": ("string", "the log's name for the object"),
    "label": ("string", "its class, in the log's words"),
    "length_m": ("double", "along the box's x axis"),
    "width_m": ("double", "along the box's y axis"),
    "height_m": ("double", "along the box's z axis"),
    "camera_SE3_box": ("matrix", "4 x 4, row by row; takes box to camera coordinates; box x forward, y left, z up"),
    "left_px": ("double", "of the rectangle around what the image shows; 0 is the image's left edge"),
    "top_px": ("double", "of that rectangle; 0 is the image's upper edge"),
    "right_px": ("double", "of that rectangle"),
    "bottom_px": ("double", "of that rectangle"),
    "truncated": ("double", "share of the uncut rectangle outside of the image, 0 to 1"),
    "occluded": ("double", "share of the object that nearer surfaces hide, 0 to 1; null where it is not known"),
    "lidar_points": ("int64", "points of the frame's LiDAR sweep in the box; -1 where there is no sweep"),
    "velocity_x_m_s": ("double", "along the camera's x axis"),
    "velocity_y_m_s": ("double", "along the camera's y axis"),
    "velocity_z_m_s": ("double", "along the camera's z axis"),
}
"""Name → kind and meaning of a column of boxes."""
