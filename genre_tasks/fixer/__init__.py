"""FNet, the one-step diffusion fixer: inputs, network, inference, training pairs and training (paper Sec. III-B)."""
