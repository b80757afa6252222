"""The operator's console: a web page to review contacts, decide, and request more data."""
