"""Pictures of artifacts, drawn with matplotlib."""
