"""A minimal layout for people's own logs: one JSON file, images, sweeps as npz, Parquet or PLY, boxes as Parquet."""
