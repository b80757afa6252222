"""Message bearers: records in messages of at most 340 bytes, as satellite terminals send them."""
