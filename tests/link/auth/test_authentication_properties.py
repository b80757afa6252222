"""Recorded, changed and lost frames in any order: no frame is accepted twice, and no forged frame once."""

from builders.authentication_world import VEHICLE, key, vehicle_authenticator, vessel_authenticator
from builders.link_state import group
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, invariant, precondition, rule

from sonarpost.errors import FrameError
from sonarpost.link.auth.authentication import RESERVED, WINDOW, FrameAuthenticator, ReplayWindow
from sonarpost.link.auth.key import AuthenticationSettings, Direction

NEAR = AuthenticationSettings().counter_step - WINDOW


def verified(authenticator: FrameAuthenticator, source: int, protected: bytes) -> tuple[bytes, str]:
    """Return the verified frame, or the field of the error."""
    try:
        return authenticator.verify(source, protected), ""
    except FrameError as error:
        return b"", error.field


class Attack(RuleBasedStateMachine):
    """A vehicle, a vessel that can restart, and an attacker who records and replays all frames."""

    def __init__(self) -> None:
        super().__init__()
        # Late in the key's lifetime, so that the vessel has few counters to try for a changed frame.
        self.durable = AuthenticationSettings().lifetime_frames - 2**16
        self.vehicle = self.start_vehicle()
        self.vessel = vessel_authenticator()
        self.recorded: list[tuple[int, bytes, bytes]] = []  # counter, plain, protected
        self.accepted: set[int] = set()
        self.newest = -1
        self.receive(*self.record(b"one"))
        assert self.receive(*self.record(b"two"))

    def start_vehicle(self) -> FrameAuthenticator:
        return FrameAuthenticator(key("fleet"), VEHICLE, Direction.FROM_VEHICLE, first_counter=self.durable)

    def record(self, data: bytes) -> tuple[int, bytes, bytes]:
        if (limit := self.vehicle.requested_limit) is not None:
            self.durable = limit
            self.vehicle.grant(limit)
        counter = self.vehicle.settings.lifetime_frames - self.vehicle.frames_left
        covered = b"\x80" + data
        self.recorded.append((counter, covered, self.vehicle.protect(covered)))
        return self.recorded[-1]

    def receive(self, counter: int, covered: bytes, protected: bytes) -> bool:
        plain, field = verified(self.vessel, VEHICLE, protected)
        assert field in {"", "counter"}
        if field:
            return False
        assert plain == covered
        assert counter not in self.accepted
        self.accepted.add(counter)
        self.newest = max(self.newest, counter)
        return True

    @rule(data=st.binary(max_size=8))
    def a_frame_arrives(self, data: bytes) -> None:
        frame = self.record(data)
        gap = frame[0] - self.newest
        assert self.receive(*frame) or gap > NEAR

    @rule(lost=st.one_of(st.integers(1, 3), st.integers(NEAR - 3, NEAR + 3), st.integers(250, 600)))
    def frames_are_lost(self, lost: int) -> None:
        for _ in range(lost):
            self.record(b"")

    @precondition(lambda self: self.recorded)
    @rule(data=st.data())
    def a_recorded_frame_arrives(self, data: st.DataObject) -> None:
        back = data.draw(st.one_of(st.integers(1, 80), st.integers(1, len(self.recorded))))
        frame = self.recorded[-min(back, len(self.recorded))]
        behind = self.newest - frame[0]
        due = frame[0] not in self.accepted and -NEAR <= behind < WINDOW
        assert self.receive(*frame) == due or behind < -NEAR

    @precondition(lambda self: self.recorded)
    @rule(data=st.data(), at=st.integers(0, 12), bit=st.integers(0, 7))
    def a_changed_frame_arrives(self, data: st.DataObject, at: int, bit: int) -> None:
        _, _, protected = data.draw(st.sampled_from(self.recorded[-20:]))
        forged = bytearray(protected)
        forged[at % len(forged)] ^= 1 << bit
        before = group(self.vessel.parts(), "window")
        assert verified(self.vessel, VEHICLE, bytes(forged)) == (b"", "tag")
        assert group(self.vessel.parts(), "window") == before

    @rule(saved=st.booleans())
    def the_vehicle_restarts(self, saved: bool) -> None:
        if saved and (limit := self.vehicle.requested_limit) is not None:
            self.durable = limit  # a crash between saving and granting
        self.vehicle = self.start_vehicle()

    @rule()
    def the_vessel_restarts(self) -> None:
        state = self.vessel.parts()
        self.vessel = vessel_authenticator()
        assert not self.vessel.restore(state)

    @invariant()
    def no_counter_is_used_twice(self) -> None:
        last = [counter for counter, _, _ in self.recorded[-2 * RESERVED :]]
        assert last == sorted(set(last))

    @invariant()
    def accepted_frames_are_counted(self) -> None:
        assert self.vessel.counts.genuine == len(self.accepted)

    def teardown(self) -> None:
        """Two more frames are accepted after any attack."""
        self.receive(*self.record(b"one"))
        assert self.receive(*self.record(b"two"))


TestAttack = Attack.TestCase


@given(st.lists(st.one_of(st.integers(-80, 80), st.integers(-80, 80), st.integers(100, 5000)), max_size=200))
def test_replay_window_agrees_with_a_set(steps: list[int]) -> None:
    window, accepted = ReplayWindow(), set[int]()
    for step in steps:
        counter = max(0, max(accepted, default=-1) + step)
        expected = counter > max(accepted, default=-1) - WINDOW and counter not in accepted
        assert window.is_new(counter) == expected
        if expected:
            window.accept(counter)
            accepted.add(counter)
        assert window.newest == max(accepted)
        assert window.seen < 1 << WINDOW


@given(st.integers(-1, 2**20), st.sampled_from([256, 65536]), st.data())
def test_nearest_counter_is_the_one_sent(newest: int, step: int, data: st.DataObject) -> None:
    sent = newest + data.draw(st.integers(1 - WINDOW, step - WINDOW))
    assert ReplayWindow(newest).nearest(sent % step, step) == sent


@given(st.binary(max_size=300), st.integers(-5, 200), st.booleans())
def test_any_bytes_are_rejected(protected: bytes, source: int, encrypt: bool) -> None:
    chosen = AuthenticationSettings(encrypt=encrypt)
    vessel = vessel_authenticator(chosen)
    assert verified(vessel, source, protected) == (b"", "tag")
    assert vessel.counts.forged == 1
    assert vessel.verify(VEHICLE, vehicle_authenticator(chosen).protect(b"\x80ok")) == b"\x80ok"
