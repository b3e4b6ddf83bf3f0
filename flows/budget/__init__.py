"""A run within a given time: which settings of a measured table fit, and stepping down where time runs short."""
