"""Short messages of vessels at c2: records to the inbox, acknowledgements to the gateway."""

import logging
import re
import threading
import time
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self, cast

from typing_extensions import override

from sonarpost import keys, wire
from sonarpost.archive.decoder import Decoder
from sonarpost.archive.image_files import PREVIEW_NOTE
from sonarpost.delivery.transaction import UnitOfWork
from sonarpost.errors import BadInputError, ConfigError, DeliveryError
from sonarpost.extensions.satellite.config import ShortMessageKeys, ShortMessageOptions
from sonarpost.extensions.satellite.receiver import ShortMessageReceiver
from sonarpost.extensions.satellite.rockblock import RockBlockAccount, TerminalMessage, Webhook, WebhookError
from sonarpost.link.state import SavedParts
from sonarpost.logs import kv
from sonarpost.messages import Decision, ReceivedImage, ReconstructedImage, Relayed
from sonarpost.runtime.service import Service
from sonarpost.services.c2.inputs import Input

if TYPE_CHECKING:
    from sonarpost.services.c2.config import C2Config

log = logging.getLogger(__name__)

MIN_TOKEN_CHARACTERS = 16
CHECK_S = 1.0
RETRY_S = 30.0


class ShortMessages(Input):
    """Accepts messages of terminals. Their records enter c2's inbox as if a relay had delivered them.

    Args:
        config: The table of c2.
        options: Its table `short_messages`.

    Raises:
        CodebookError: A codebook cannot be read.
        ConfigError: A secret is invalid.
    """

    KEYS = ShortMessageKeys

    def __init__(self, config: "C2Config", options: ShortMessageOptions) -> None:
        self._config = options
        self._site = config.site
        self._token = _secret(options.token_file, MIN_TOKEN_CHARACTERS)
        if not re.fullmatch(r"[A-Za-z0-9_-]+", self._token):
            raise ConfigError(str(options.token_file), "", "other characters", "letters, digits, - and _")
        self._account = RockBlockAccount(options.gateway, options.username, _secret(options.password_file, 1))
        self._decoder = Decoder(config.codebooks)
        self._webhook: Webhook | None = None
        self._lock = threading.Lock()
        self._terminals = {vessel: imei for imei, vessel in self._config.vessels.items()}
        self._receivers: dict[str, tuple[ShortMessageReceiver, SavedParts]] = {}
        # Why a vessel's messages are not acknowledged at present.
        self._faults: dict[str, str] = {}

    @classmethod
    @override
    def configured(cls, config: "C2Config") -> Self | None:
        """Return the input for the table of c2; None without `short_messages`."""
        options = cast(ShortMessageKeys, config).short_messages
        return None if options is None else cls(config, options)

    @override
    def faults(self) -> Iterable[str]:
        """Return whose messages are not acknowledged at present, and why."""
        return list(self._faults.values())

    @property
    def port(self) -> int:
        """Port of the open webhook."""
        assert self._webhook is not None
        return self._webhook.port

    @override
    def open(self, service: Service[Any]) -> None:
        self._store = service.store
        self._count = service.count
        self._check_capacity = service.check_capacity
        self._before_accepting = service.before_accepting
        self._log = service.interval_log(log, logging.WARNING, "Short message refused or not acknowledged")
        self._webhook = Webhook(self._config.host, self._config.port, self._token, self._receive)
        log.info("Webhook for short messages open", extra=kv(host=self._config.host, port=self._webhook.port))

    @override
    def close(self) -> None:
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
        with self._lock, self._receiver(vessel) as receiver:
            self._check_capacity(inbox)
            now_s = time.time()
            records = receiver.receive(data, now_s)
            self._save(vessel, [(inbox, wire.encode(self._envelope(vessel, record, now_s))) for record in records])
        for record in records:
            self._count(f"short_{'decisions' if isinstance(record, Decision) else 'contacts'}_received")

    @contextmanager
    def _receiver(self, vessel: str) -> Iterator[ShortMessageReceiver]:
        """Return the receiver of a vessel; after an error its state is read again. Requires the lock."""
        if vessel not in self._receivers:
            receiver = ShortMessageReceiver(vessel)
            saved = self._store.read_states(_prefix(vessel), receiver.restore)
            self._receivers[vessel] = (receiver, SavedParts(saved))
        try:
            yield self._receivers[vessel][0]
        except BaseException:
            self._receivers.pop(vessel, None)
            raise

    def _save(self, vessel: str, accepted: Sequence[tuple[str, bytes]] = ()) -> None:
        """Commit the state of a receiver together with records for the inbox. Requires the lock."""
        receiver, saved = self._receivers[vessel]
        parts = receiver.parts()
        effects = UnitOfWork()
        effects.put_states(_prefix(vessel), saved.changes(parts))
        with self._store.transaction() as tx:
            if accepted:
                self._before_accepting(accepted)
            effects.write(tx)
            for record in accepted:
                tx.accept(*record)
        saved.commit(parts)
        for _ in range(receiver.take_lost()):
            self._count("short_decisions_lost")
            self._log.log(vessel=vessel, reason="fragments of a decision do not fit together, or are too many")

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
        except Exception as error:
            if not isinstance(error, BadInputError):
                log.exception("Preview not decoded after an unexpected exception")
            reason = (f"the preview cannot be decoded: {error}"[:2000],)
            decoded = self._decoder.decode(image.model_copy(update={"stream": b"", "missing": ()}))
        return decoded.model_copy(update={"notes": (PREVIEW_NOTE, *decoded.notes, *reason), "complete": False})

    @override
    def run(self, stopping: threading.Event) -> None:
        """Send acknowledgements until `stopping` is set. A failure delays those of its vessel only."""
        retry_s: dict[str, float] = {}
        while not stopping.wait(CHECK_S):
            for vessel, imei in self._terminals.items():
                if stopping.is_set() or time.monotonic() < retry_s.get(vessel, 0.0):
                    continue
                try:
                    self._acknowledge(vessel, imei)
                    self._faults.pop(vessel, None)
                except Exception as error:
                    retry_s[vessel] = time.monotonic() + RETRY_S
                    self._faults[vessel] = f"short messages of {vessel} not acknowledged: {error}"
                    self._count("short_acknowledgements_failed")
                    if not isinstance(error, DeliveryError):
                        log.exception("Short messages not acknowledged after an unexpected exception")
                    elif not stopping.is_set():
                        self._log.log(vessel=vessel, error=str(error))

    def _acknowledge(self, vessel: str, imei: str) -> None:
        with self._lock, self._receiver(vessel) as receiver:
            acknowledgements = receiver.acknowledgements(time.time())
        if not acknowledgements:
            return
        try:
            for data in acknowledgements:
                self._account.send(imei, data)
                self._count("short_messages_acknowledged")
        except BaseException:
            with self._lock:
                # They are due again, or covered by those of messages that have arrived since.
                self._receivers.pop(vessel, None)
            raise
        with self._lock, self._receiver(vessel):
            self._save(vessel)


def _prefix(vessel: str) -> str:
    return f"short/{vessel}/"


def _secret(path: Path, min_characters: int) -> str:
    try:
        text = path.read_text(encoding="ascii").strip()
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError(str(path), "", str(error), "a readable file with a secret") from error
    if len(text) < min_characters:
        raise ConfigError(str(path), "", f"{len(text)} characters", f"at least {min_characters} characters")
    return text
