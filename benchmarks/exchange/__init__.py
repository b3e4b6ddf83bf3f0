"""Exchange with other programs: formats, viewers and simulators."""
