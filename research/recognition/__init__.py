"""How well a classifier recognises targets in decoded images."""
