"""User study: how well people recognise decoded images."""
