"""KITTI's raw recordings, with the boxes of its tracklets or of its tracking benchmark."""
