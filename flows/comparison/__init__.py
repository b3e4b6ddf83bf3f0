"""What differs between two runs or two artifacts: settings, digests, metrics, Gaussians and images."""
