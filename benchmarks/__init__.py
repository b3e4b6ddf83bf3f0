"""Every number in a document comes from here: one module per set of claims, one schema, one way to measure."""
