"""The operator's page of a demo: its address, its user, and waiting until it is closed."""

from __future__ import annotations

import importlib
import secrets
import time

from rich.console import Console

from sonarpost.cli.demo.chain import Chain
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
        console.print(f"operator's page: {self.address}  user {USER}  password {self._password}", highlight=False)

    def keep_open(self, chain: Chain, console: Console) -> None:
        """Wait for Ctrl-C.

        Raises:
            ChainError: A process of the chain has ended.
        """
        self.show(console)
        console.print("open until Ctrl-C; the contact sheet follows")
        try:
            while True:
                chain.check()
                time.sleep(0.5)
        except KeyboardInterrupt:
            return
