"""The public PandaSet layout: its reader, a writer, and pickles read without running anything in them."""
