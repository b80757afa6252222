"""Database of the console: contacts, decisions, requests, users."""
