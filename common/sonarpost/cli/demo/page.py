"""The operator's page of a demo: who may log in, where it is, open until somebody ends it."""

from __future__ import annotations

import importlib
import secrets
import time

from rich.console import Console

from sonarpost.cli.demo.chain import Chain
from sonarpost.cli.demo.settings import VESSEL, ChainSettings

USER = "op"


class Page:
    """The console of a demo's vessel, with one operator.

    Args:
        settings: Of the chain; `console_port` is the page's.
    """

    def __init__(self, settings: ChainSettings) -> None:
        self._password = secrets.token_urlsafe(9)
        self.address = f"http://127.0.0.1:{settings.console_port}/"
        # Commands know services by name only.
        users_file = importlib.import_module("sonarpost.services.console.store.users")
        users = users_file.Users(settings.folder / "state" / VESSEL / users_file.FILE_NAME)
        try:
            users.add(USER, "operator", self._password)
        finally:
            users.close()

    def show(self, console: Console) -> None:
        """Say where it is and who may log in."""
        console.print(f"the operator's page: {self.address}  user {USER}  password {self._password}", highlight=False)

    def leave_open(self, chain: Chain, console: Console) -> None:
        """Wait until somebody presses Ctrl-C, or a process of the chain ends.

        Raises:
            ChainError: One did.
        """
        self.show(console)
        console.print("open until Ctrl-C; the contact sheet follows")
        try:
            while True:
                chain.check()
                time.sleep(0.5)
        except KeyboardInterrupt:
            return
