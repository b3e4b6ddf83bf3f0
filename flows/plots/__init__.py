"""Pictures of artifacts, drawn with matplotlib and Pillow."""
