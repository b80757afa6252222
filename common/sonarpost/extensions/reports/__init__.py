"""Text reports of contacts: `caris.txt` and `app11-like.txt`."""
