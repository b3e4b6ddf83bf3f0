"""The stages: thin compositions of the other rooms, each a function ``stage(config, inputs) -> outputs``.

A stage is a function from values to values, which a notebook can call; ``flows`` runs them in order and stores what
they return.
"""
