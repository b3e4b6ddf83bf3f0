"""Reads images with camera poses, as nerfstudio, instant-ngp and COLMAP write them, as a driving log without LiDAR."""
