"""A run within a given time: the measured settings, the deadline, and the choice of what fits."""
