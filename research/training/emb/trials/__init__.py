"""Trials of changes to the codec `emb` that were not kept; docs/research/codecs.md has their results."""
