"""How far beside the path a scene can be trusted, told without knowing the truth."""
