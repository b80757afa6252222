"""Functions for an operator's review: decisions, grouping, measurement, cost, rendering. No input or output."""
