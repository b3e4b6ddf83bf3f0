"""The stages: thin compositions of the other rooms, each ``stage(config, inputs) -> outputs``."""
