"""Fixtures of the console from `builders.console`."""

from builders.console import console, fast_password_hashes, make_console, users_file

__all__ = ["console", "fast_password_hashes", "make_console", "users_file"]
