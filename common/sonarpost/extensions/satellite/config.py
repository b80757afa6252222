"""Keys of satellite terminals in the tables of the relay and of c2."""

from pathlib import Path
from typing import Annotated

from pydantic import Field, field_validator, model_validator

from sonarpost.config import ServiceConfig
from sonarpost.extensions.satellite.policy import Window
from sonarpost.messages import PlatformId

Imei = Annotated[str, Field(pattern=r"^[0-9]{15}$")]


class SatelliteKeys(ServiceConfig):
    """Keys of an upstream with `bearer = "satellite"`.

    The site receives short messages with contact records, previews and decisions that no radio upstream of the site has
    delivered within `after_s`.

    Attributes:
        terminal: Satellite only: serial port of an Iridium 9602 or 9603, or another URL of pyserial.
        baud: Satellite only: bits a second.
        after_s: Satellite only: time that a record waits for the radio first; not used for a site without radio.
        preview_bytes: Satellite only: longest preview of an image. Up to 260 fit a message of one contact; with 75,
            two contacts share a message. 0 sends contact records only.
        bytes_per_day: Satellite only: limit for sent bytes a day in UTC; no limit by default.
        windows: Satellite only: times of the day in UTC when it is used, `HH:MM-HH:MM`; empty for always.
        check_interval_s: Satellite only: interval of the checks for acknowledgements.
        cost_per_kb: Satellite only: price of 1000 bytes, for the gauge of the cost.
    """

    terminal: str = ""
    baud: Annotated[int, Field(ge=300, le=1_000_000)] = 19200
    after_s: Annotated[float, Field(ge=0, le=604800)] = 120.0
    preview_bytes: Annotated[int, Field(ge=0, le=260)] = 260
    bytes_per_day: Annotated[int, Field(ge=340)] | None = None
    windows: tuple[str, ...] = ()
    check_interval_s: Annotated[float, Field(ge=1, le=86400)] = 120.0
    cost_per_kb: Annotated[float, Field(ge=0, le=1e6)] | None = None

    @field_validator("windows")
    @classmethod
    def _check_windows(cls, windows: tuple[str, ...]) -> tuple[str, ...]:
        for text in windows:
            Window.parse(text)
        return windows

    @model_validator(mode="after")
    def _check_terminal(self) -> "SatelliteKeys":
        if getattr(self, "bearer", "") == "satellite" and not self.terminal:
            raise ValueError("a terminal with bearer satellite")
        return self


class ShortMessageOptions(ServiceConfig):
    """The `short_messages` table of c2: messages of satellite terminals, through a gateway like RockBLOCK's.

    Attributes:
        vessels: IMEI of the terminal = name of its vessel.
        token_file: File with a secret of at least 16 characters: the gateway's address for deliveries is
            `http://HOST:PORT/SECRET`.
        host: Address of the webhook, without TLS; a reverse proxy adds it.
        port: Port of the webhook; 0 for any.
        gateway: Address of the gateway, for acknowledgements.
        username: Name of the account at the gateway.
        password_file: File with its password.
    """

    vessels: Annotated[dict[Imei, PlatformId], Field(min_length=1)]
    token_file: Path
    host: str = "127.0.0.1"
    port: Annotated[int, Field(ge=0, le=65535)] = 8480
    gateway: Annotated[str, Field(pattern=r"^https?://")]
    username: str
    password_file: Path


class ShortMessageKeys(ServiceConfig):
    """Keys of c2.

    Attributes:
        short_messages: Reception of short messages from satellite terminals; none by default.
    """

    short_messages: ShortMessageOptions | None = None
