"""Comparison of the despeckling network of emb with classical filters."""
