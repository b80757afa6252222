"""Store-and-forward between the vessel and its shore sites."""
