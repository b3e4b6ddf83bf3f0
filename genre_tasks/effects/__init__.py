"""Effects: parts of the forward model that a scene may or may not need. Each has a file; ``plan`` asks them all."""
