"""The learned optimiser: its network, features and weights, and its meta-training."""
