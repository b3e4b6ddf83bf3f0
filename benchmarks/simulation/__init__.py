"""Claims about re-simulation."""
