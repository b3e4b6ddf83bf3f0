"""The typed driving log and its readers."""
