"""The operator's page of a demo: its address and its user."""

from __future__ import annotations

import importlib
import secrets

from rich.console import Console

from sonarpost.cli.demo.settings import VESSEL, ChainSettings

USER = "op"


class OperatorPage:
    """The console of the demo's vessel, with one operator.

    Args:
        settings: Settings of the chain, with `console_port`.
    """

    def __init__(self, settings: ChainSettings) -> None:
        self._password = secrets.token_urlsafe(9)
        self.address = f"http://127.0.0.1:{settings.console_port}/"
        # A command imports a service by name only: the import rules separate them.
        users_file = importlib.import_module("sonarpost.services.console.store.users")
        users = users_file.Users(settings.folder / "state" / VESSEL / users_file.FILE_NAME)
        try:
            users.add(USER, "operator", self._password)
        finally:
            users.close()

    def show(self, console: Console) -> None:
        """Print the address, the user and the password."""
        console.print(f"operator's page: {self.address}  user: {USER}  password: {self._password}", highlight=False)
