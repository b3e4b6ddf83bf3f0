"""The stages as data, and how one stage of one chunk is looked up, computed and committed."""
