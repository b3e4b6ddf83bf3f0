"""Detection of objects in images by networks of other people: boxes, classes and masks, and how far two sets agree."""
