"""What perception gains from scenes: labelled images of moved viewpoints."""
