"""How good images are: against their truth, against recorded images, and as sets."""
