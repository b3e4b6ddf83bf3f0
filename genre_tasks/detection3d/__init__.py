"""A small monocular detector of boxes in space: trained from scratch to tell whether training images are worth it."""
