"""Functions for an operator's review: grouping, measurement, cost of requests, rendering. No input or output."""
