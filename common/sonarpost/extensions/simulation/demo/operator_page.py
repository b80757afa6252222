"""The operator's page of a demo: its address, its user and a log-in link."""

from __future__ import annotations

import secrets
import webbrowser

from rich.console import Console

from sonarpost.extensions.simulation.demo.settings import VESSEL, ChainSettings
from sonarpost.services.console.store.users import FILE_NAME, LINK_S, Users, login_link

USER = "op"


class OperatorPage:
    """The console of the demo's vessel, with one operator.

    Args:
        settings: Settings of the chain, with `console_port`.
    """

    def __init__(self, settings: ChainSettings) -> None:
        self._password = secrets.token_urlsafe(9)
        self.address = f"http://127.0.0.1:{settings.console_port}/"
        self._path = settings.folder / "state" / VESSEL / FILE_NAME
        users = Users(self._path)
        try:
            users.add(USER, "operator", self._password)
        finally:
            users.close()

    def login_link(self) -> str:
        """Return a new log-in link, which is valid once, for 10 minutes."""
        users = Users(self._path)
        try:
            return login_link(self.address, users.make_login_link(USER))
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
            f"log-in link, valid once, for {LINK_S / 60:.0f} minutes: {self.login_link()}",
        ):
            console.print(line, highlight=False, soft_wrap=True)
        if opened:
            webbrowser.open(self.login_link())
