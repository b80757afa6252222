"""Short messages of vessels at c2: records to the inbox, acknowledgements to the gateway."""

from __future__ import annotations

import logging
import re
import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from sonarpost import keys, wire
from sonarpost.archive.decoder import Decoder
from sonarpost.archive.image_files import PREVIEW_NOTE
from sonarpost.bearers.receiver import MessageReceiver
from sonarpost.bearers.rockblock import RockBlockAccount, TerminalMessage, Webhook, WebhookError
from sonarpost.delivery.store import Store
from sonarpost.errors import BadInputError, CodebookError, ConfigError, DeliveryError, StreamError
from sonarpost.logs import IntervalLog, kv
from sonarpost.messages import Decision, ReceivedImage, ReconstructedImage, Relayed
from sonarpost.services.c2.config import ShortMessageOptions

log = logging.getLogger(__name__)

MIN_TOKEN_CHARACTERS = 16
CHECK_S = 1.0
RETRY_S = 30.0


@dataclass(frozen=True, slots=True)
class Access:
    """Secrets of the webhook and of the gateway.

    Attributes:
        token: Part of the webhook's address.
        account: Account at the gateway.
    """

    token: str
    account: RockBlockAccount

    @classmethod
    def read(cls, config: ShortMessageOptions) -> Access:
        """Read the files of a configuration.

        Raises:
            ConfigError: A secret cannot be read, is too short, or has other characters.
        """
        token = _secret(config.token_file, MIN_TOKEN_CHARACTERS)
        if not re.fullmatch(r"[A-Za-z0-9_-]+", token):
            raise ConfigError(str(config.token_file), "", "other characters", "letters, digits, - and _")
        return cls(token, RockBlockAccount(config.gateway, config.username, _secret(config.password_file, 1)))


class ShortMessages:
    """Accepts messages of terminals. Their records enter c2's inbox as if a relay had delivered them.

    Args:
        config: Configuration.
        access: Its secrets.
        codebooks: Names or files of tile codebooks.
        site: Name of the site.
        store: Store of c2, with the inbox.
        count: Increases a health counter.
        check_capacity: Raises RetryLaterError if a record on a key cannot be stored now.
        interval_log: Log of refused messages and failed acknowledgements.

    Raises:
        CodebookError: A codebook cannot be read.
    """

    def __init__(
        self,
        config: ShortMessageOptions,
        access: Access,
        codebooks: Sequence[str],
        site: str,
        store: Store,
        count: Callable[[str], None],
        check_capacity: Callable[[str], None],
        interval_log: IntervalLog,
    ) -> None:
        self._config = config
        self._site = site
        self._store = store
        self._count = count
        self._check_capacity = check_capacity
        self._log = interval_log
        self._access = access
        self._decoder = Decoder(codebooks)
        self._webhook: Webhook | None = None
        self._lock = threading.Lock()
        self._terminals = {vessel: imei for imei, vessel in config.vessels.items()}

    @property
    def port(self) -> int:
        """Port of the open webhook."""
        assert self._webhook is not None
        return self._webhook.port

    def open(self) -> None:
        """Open the webhook."""
        self._webhook = Webhook(self._config.host, self._config.port, self._access.token, self._receive)
        log.info("Webhook for short messages open", extra=kv(host=self._config.host, port=self._webhook.port))

    def close(self) -> None:
        """Close the webhook."""
        if self._webhook is not None:
            self._webhook.close()

    def _receive(self, message: TerminalMessage) -> None:
        """Commit the records of a message to the inbox.

        Raises:
            BadInputError: The message is refused.
            DeliveryError: It cannot be stored now.
        """
        try:
            vessel = self._config.vessels.get(message.imei)
            if vessel is None:
                raise WebhookError("webhook", "imei", message.imei, "a terminal in [c2] short_messages.vessels")
            if message.data:  # a terminal that checks its mailbox can send an empty message
                self._accept(vessel, message.data)
        except BadInputError as error:
            self._count("short_messages_refused")
            self._log.log(imei=message.imei, reason=str(error))
            raise
        self._count("short_messages_received")

    def _accept(self, vessel: str, data: bytes) -> None:
        inbox = keys.shore_inbox(vessel, self._site)
        with self._lock:
            self._check_capacity(inbox)
            receiver = self._receiver(vessel)
            now_s = time.time()
            records = receiver.receive(data, now_s)
            payloads = [wire.encode(self._envelope(vessel, record, now_s)) for record in records]
            with self._store.transaction() as tx:
                tx.put_state(_state_name(vessel), receiver.pack())
                for payload in payloads:
                    tx.accept(inbox, payload)
        for record in records:
            self._count(f"short_{'decisions' if isinstance(record, Decision) else 'contacts'}_received")

    def _receiver(self, vessel: str) -> MessageReceiver:
        state = self._store.get_state(_state_name(vessel))
        return MessageReceiver(vessel) if state is None else MessageReceiver.unpack(vessel, state)

    def _envelope(self, vessel: str, record: ReceivedImage | Decision, now_s: float) -> Relayed:
        if isinstance(record, Decision):
            key, payload = keys.contact_decision(vessel), wire.encode(record)
        else:
            key, payload = keys.image_reconstructed(vessel), wire.encode(self._decoded(record))
        return Relayed(vessel_id=vessel, key=key, payload=payload, relayed_utc_s=now_s)

    def _decoded(self, image: ReceivedImage) -> ReconstructedImage:
        """Return the preview; without it, the contact record alone."""
        reason: tuple[str, ...] = ()
        try:
            decoded = self._decoder.decode(image)
        except (CodebookError, StreamError) as error:
            reason = (f"the preview cannot be decoded: {error}"[:2000],)
            decoded = self._decoder.decode(image.model_copy(update={"stream": b"", "missing": ()}))
        return decoded.model_copy(update={"notes": (PREVIEW_NOTE, *decoded.notes, *reason), "complete": False})

    def run(self, stopping: threading.Event) -> None:
        """Send acknowledgements until `stopping` is set."""
        retry_s = 0.0
        while not stopping.wait(CHECK_S):
            if time.monotonic() < retry_s:
                continue
            try:
                for vessel, imei in self._terminals.items():
                    self._acknowledge(vessel, imei)
            except DeliveryError as error:
                retry_s = time.monotonic() + RETRY_S
                if not stopping.is_set():
                    self._log.log(error=str(error))

    def _acknowledge(self, vessel: str, imei: str) -> None:
        name = _state_name(vessel)
        with self._lock:
            receiver = self._receiver(vessel)
            before = receiver.pack()
            acknowledgements = receiver.acknowledgements(time.time())
        for data in acknowledgements:
            self._access.account.send(imei, data)
            self._count("short_messages_acknowledged")
        with self._lock:
            # Otherwise messages have arrived since then, and are acknowledged again with these.
            if acknowledgements and self._store.get_state(name) == before:
                with self._store.transaction() as tx:
                    tx.put_state(name, receiver.pack())


def _state_name(vessel: str) -> str:
    return f"short/{vessel}"


def _secret(path: Path, min_characters: int) -> str:
    try:
        text = path.read_text(encoding="ascii").strip()
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError(str(path), "", str(error), "a readable file with a secret") from error
    if len(text) < min_characters:
        raise ConfigError(str(path), "", f"{len(text)} characters", f"at least {min_characters} characters")
    return text
