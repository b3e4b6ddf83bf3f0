"""Re-simulation of finished runs: rollouts, edits, and what they leave in a folder."""
