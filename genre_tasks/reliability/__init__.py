"""How far beside the path a scene can be trusted, estimated without knowing the truth."""
