"""Training sets for detectors: images with labelled boxes, written in the layouts that other people's trainers read."""
