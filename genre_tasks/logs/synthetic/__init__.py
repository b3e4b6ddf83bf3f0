"""A procedural street, ray-cast: a log whose true image is known at every viewpoint."""

from genre_tasks.logs.synthetic.log import StreetTruth, SyntheticStreet, open_synthetic

__all__ = ["StreetTruth", "SyntheticStreet", "open_synthetic"]
