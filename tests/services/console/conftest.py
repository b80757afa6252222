"""Fixtures of these tests from `builders.console`."""

from builders.console import console, fast_password_hashes, make_console, make_shared_console, users_file

__all__ = ["console", "fast_password_hashes", "make_console", "make_shared_console", "users_file"]
