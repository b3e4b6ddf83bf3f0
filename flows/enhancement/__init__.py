"""A scene that another program made goes through the pipeline: what ``genre enhance`` asks a run for."""
