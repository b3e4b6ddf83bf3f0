"""Effects: parts of the forward model that a scene may or may not need.

Each effect has a module of its name, whose ``EFFECT`` says which property of a log decides and at which threshold.
``plan`` asks them all, and ``apply_plan`` gives a chunk what the plan decided.
"""
