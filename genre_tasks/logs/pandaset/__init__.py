"""The public PandaSet layout: its reader and a writer."""
