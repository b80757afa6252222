"""Model of durable delivery for an exhaustive search over small configurations.

`docs/specifications/delivery.md` specifies states, messages and invariants; the names are the same here. `rules` holds
the rules that can be switched, `machine` the transitions, `invariants` the checks, `search` the breadth-first search
and `scenarios` the configurations. `python -m research.delivery_model` prints a table of all configurations.
"""
