"""The operator's page of a demo: its address, its user and a log-in link."""

from __future__ import annotations

import importlib
import secrets
import webbrowser

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
        self._module = importlib.import_module("sonarpost.services.console.store.users")
        self._path = settings.folder / "state" / VESSEL / self._module.FILE_NAME
        users = self._module.Users(self._path)
        try:
            users.add(USER, "operator", self._password)
        finally:
            users.close()

    def login_link(self) -> str:
        """Return a new log-in link, which is valid once, for 10 minutes."""
        users = self._module.Users(self._path)
        try:
            return str(self._module.login_link(self.address, users.make_login_link(USER)))
        finally:
            users.close()

    def show(self, console: Console, *, opened: bool = False) -> None:
        """Print the address, the user, the password and a log-in link.

        Args:
            console: Console to print on.
            opened: Whether to open another link in the default browser.
        """
        for line in (
            f"operator's page: {self.address}  user: {USER}  password: {self._password}",
            f"log-in link, valid once, for {self._module.LINK_S / 60:.0f} minutes: {self.login_link()}",
        ):
            console.print(line, highlight=False, soft_wrap=True)
        if opened:
            webbrowser.open(self.login_link())
