"""C2: the shore side."""
