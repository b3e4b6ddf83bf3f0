"""C++ kernels of the optimiser: posing of Gaussians, and the learned step with its state."""
