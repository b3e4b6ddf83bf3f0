"""What all benchmarks share: cells, claims, the runner, timing, and the logs and stages that they run."""
