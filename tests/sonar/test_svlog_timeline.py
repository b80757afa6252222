"""Cerulean SVLOG: sessions, clocks of sonars and computer, counters of the transducers, batches."""

from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from itertools import pairwise

import numpy as np
import pytest
from builders.surveys import svlog_mavlink, svlog_packet, svlog_position, svlog_profile, svlog_session
from hypothesis import given
from hypothesis import strategies as st

from sonarpost.sonar.readers import open_survey, read_survey
from sonarpost.sonar.survey import Side

START = datetime(2026, 7, 23, 11, 45, tzinfo=UTC)
START_S = START.timestamp()
SIDES = (Side.PORT, Side.STARBOARD)


def profile(number, clock_ms, side, mark=(0, 0), **values):
    """Return a profile of a side whose first samples have a mark."""
    values = {"look_angle": 90.0 if side else -90.0, "max_db": 65.535} | values
    return svlog_profile(number, round(clock_ms), values.pop("channel", side), np.array([*mark, 9]), **values)


def mark_of(channel):
    """Return the mark in the samples, which are decibels in thousandths."""
    return tuple(np.rint(20_000 * np.log10(channel.samples[:2].astype(float))).astype(int).tolist())


def session(utc_s=START_S, uptime_s=1000.0):
    return svlog_session(datetime.fromtimestamp(utc_s, UTC).isoformat(), uptime_s)


def read(tmp_path, *packets):
    path = tmp_path / "line.svlog"
    path.write_bytes(b"".join(packets))
    return read_survey(path)


def times_s(survey):
    return [round(ping.time_utc_s - START_S, 3) for ping in survey]


def has_note(survey, text):
    return any(text in warning for warning in survey.warnings)


@dataclass
class Sonar:
    """Two transducers that write in batches, and what is known of their pings.

    Attributes:
        interval_ms: Interval of the pings.
        lag_ms: Time of starboard after port, as a share of the interval.
        batch: Number of profiles of one transducer one after the other.
        lead: Counter of starboard minus that of port.
        lost: Profiles that are not in the file, every so many.
        channels: Channel numbers of port and starboard.
        angles: Their look angles.
    """

    interval_ms: int = 50
    lag: float = 0.16
    batch: int = 1
    lead: int = 0
    lost: tuple[int, int] = (0, 0)
    channels: tuple[int, int] = (0, 1)
    angles: tuple[float, float] = (-90.0, 90.0)

    def is_lost(self, row, side):
        return self.lost[side] > 0 and row % self.lost[side] == self.lost[side] - 1

    def packets(self, part, count, clock_ms, first_number=100):
        """Return the profiles of a part of a recording, marked with its number and with their rows."""
        made = []
        for first in range(0, count, self.batch):
            for side in (0, 1):
                for row in range(first, min(first + self.batch, count)):
                    if not self.is_lost(row, side):
                        made.append(
                            profile(
                                first_number + row + side * self.lead,
                                clock_ms + self.interval_ms * (row + side * self.lag),
                                side,
                                (part + 1, row + 1),
                                channel=self.channels[side],
                                look_angle=self.angles[side],
                            )
                        )
        return made

    def pings(self, part, count, start_s):
        """Return mark, time and sides of the pings of the same part, in their order."""
        made = []
        for row in range(count):
            found = [side for side in (0, 1) if not self.is_lost(row, side)]
            if found:
                offset_ms = self.interval_ms * (row + min(found) * self.lag)
                names = tuple(SIDES[side] for side in found)
                made.append(((part + 1, row + 1), start_s + offset_ms / 1000, names))
        return made


@st.composite
def sonars(draw):
    lost = st.sampled_from((0, 0, 5, 7, 11))
    angles = [st.floats(1, 179).map(lambda angle, sign=sign: sign * angle) for sign in (-1, 1)]
    lead = draw(st.sampled_from((0, 0, -1, 1, 60, -17, 5000)))
    return Sonar(
        interval_ms=draw(st.integers(20, 300)),
        lag=draw(st.sampled_from((0.0, 0.1, 0.3, 0.45 if lead else 0.5))),
        batch=draw(st.sampled_from((1, 1, 2, 3, 10, 25, 63))),
        lead=lead,
        lost=(draw(lost), draw(lost)),
        channels=draw(st.sampled_from(((0, 1), (1, 0), (255, 255), (0, 0), (4, 9)))),
        angles=(draw(angles[0]), draw(angles[1])),
    )


@dataclass
class Part:
    """A session: its pings, its start after that of the session before, and its clocks at the first profile."""

    count: int
    start_s: int
    clock_s: int
    wait_s: int
    uptime_s: float | None
    first_number: int


@st.composite
def parts(draw):
    clock_s, wait_s = draw(st.integers(0, 10**6)), draw(st.sampled_from((0, 3, 9)))
    away_s = draw(st.sampled_from((None, None, -100_000, -2400, -70, 70, 2400, 10**6)))
    return Part(
        count=draw(st.integers(30, 200)),
        start_s=draw(st.sampled_from((600, 7200, 200_000))),
        clock_s=clock_s,
        wait_s=wait_s if away_s is None else 0,
        uptime_s=clock_s - wait_s if away_s is None else max(clock_s + away_s, 0) if clock_s > 70 else None,
        first_number=draw(st.integers(100, 10**6)),
    )


@given(sonar=sonars(), made=st.lists(parts(), min_size=1, max_size=3))
def test_pings_have_their_sides_times_and_order_in_any_layout(tmp_path_factory, sonar, made):
    packets, pings, start_s = [], [], START_S
    for number, part in enumerate(made):
        start_s += part.start_s
        packets.append(session(start_s, part.uptime_s))
        packets += sonar.packets(number, part.count, 1000 * part.clock_s, part.first_number)
        pings += sonar.pings(number, part.count, start_s + part.wait_s)
    survey = read(tmp_path_factory.mktemp("svlog"), *packets)
    found = [(mark_of(ping.channels[0]), tuple(channel.side for channel in ping.channels)) for ping in survey]
    assert found == [(mark, sides) for mark, _, sides in pings]
    assert all(len({mark_of(channel) for channel in ping.channels}) == 1 for ping in survey)
    differences_s = [ping.time_utc_s - utc_s for ping, (_, utc_s, _) in zip(survey, pings, strict=True)]
    assert max(map(abs, differences_s)) < 0.002
    assert not has_note(survey, "time goes back")


def test_the_counters_may_differ(tmp_path):
    for lead, text in ((0, "ping numbers"), (-1, "ping numbers of the transducers differ by 1 (1 times)")):
        survey = read(tmp_path, session(), *Sonar(lead=lead).packets(0, 20, 10**6))
        assert has_note(survey, text) is bool(lead)
        assert [ping.number for ping in survey] == list(range(100, 120))


def test_unrelated_counters_are_joined_by_time(tmp_path):
    rng = np.random.default_rng(4)
    packets = []
    for first in range(0, 60, 3):
        for side in (0, 1):
            for row in range(first, first + 3):
                number = int(rng.integers(0, 10**9)) if side else row
                packets.append(profile(number, 10**6 + 50 * row + 9 * side, side, (1, row + 1)))
    survey = read(tmp_path, session(), *packets)
    assert [[mark_of(channel)[1] for channel in ping.channels] for ping in survey] == [[n, n] for n in range(1, 61)]
    assert has_note(survey, "ping numbers of the transducers are unrelated: profiles are joined by time (1 times)")
    constant = [profile(7, 10**6 + 50 * row + 9 * side, side, (1, row + 1)) for row in range(40) for side in (0, 1)]
    survey = read(tmp_path, session(), *constant)
    assert [[mark_of(channel)[1] for channel in ping.channels] for ping in survey] == [[n, n] for n in range(1, 41)]


@pytest.mark.parametrize("shift_s", [-2000, -5.0, -0.5, 0.7, 30.0, 90_000])
def test_transducers_that_were_switched_on_apart_have_clocks_of_their_own(tmp_path, shift_s):
    packets = [
        profile(row, 1000 * (5000 + shift_s * side) + 50 * row, side, (1, row + 1))
        for row in range(90)
        for side in (0, 1)
    ]
    survey = read(tmp_path, session(uptime_s=4999.0), *packets)
    assert [[mark_of(channel)[1] for channel in ping.channels] for ping in survey] == [[n, n] for n in range(1, 91)]
    assert times_s(survey)[::89] == [1.0, 5.45]
    assert has_note(survey, f"clocks of the transducers differ by {abs(shift_s):.4g} s")


def test_clocks_that_drift_apart_stay_joined(tmp_path):
    """One clock is 1 in 1000 faster: after 1500 pings they differ by more than an interval."""
    packets = [
        profile(row, 10**6 + 50 * row * (1 + 0.001 * side), side, (1 + row // 1000, 1 + row % 1000))
        for row in range(1500)
        for side in (0, 1)
    ]
    survey = read(tmp_path, session(), *packets)
    assert {len(ping.channels) for ping in survey} == {2}
    assert all(len({mark_of(channel) for channel in ping.channels}) == 1 for ping in survey)


@pytest.mark.parametrize("uptime_s", [600.0, 5000.0, 86_400.0, None])
def test_first_profile_of_another_clock_is_at_the_date_of_the_session(tmp_path, uptime_s):
    packets = Sonar().packets(0, 3, 3_003_574)
    survey = read(tmp_path, session(uptime_s=uptime_s), *packets)
    assert times_s(survey) == [0.0, 0.05, 0.1]
    assert has_note(survey, "another clock than the session: times are early by the unknown delay of the first")
    # The messages of the autopilot measure the time from the date on.
    boots_s = (50.0, 51.0, 52.0, 9000.0, 9001.5)  # a second autopilot
    messages = [svlog_position(48.4, -68.8, 90.0, 1.0, round(1000 * boot_s)) for boot_s in boots_s]
    survey = read(tmp_path, session(uptime_s=uptime_s), *messages, *packets)
    assert times_s(survey) == [3.5, 3.55, 3.6]
    assert has_note(survey, "another clock than the session: times are right to about 1 s, by the MAVLink messages")


@pytest.mark.parametrize(
    ("after_s", "time_s", "note"),
    [
        (0.0, 0.0, ""),
        (9.0, 9.0, ""),
        (-0.5, -0.5, ""),
        (40.0, 40.0, "differ by 40 s: times may be late by as much"),
        (-20.0, 0.0, "another clock than the session"),
        (70.0, 0.0, "another clock than the session"),
    ],
)
def test_clock_near_that_of_the_computer_is_the_same(tmp_path, after_s, time_s, note):
    survey = read(tmp_path, session(uptime_s=1000.0), *Sonar().packets(0, 3, 10**6 + 1000 * after_s))
    assert times_s(survey)[0] == time_s
    assert has_note(survey, note)
    assert has_note(survey, "clock") is bool(note)


def received(kind, utc_s):
    """Return a packet with a received time."""
    when = datetime.fromtimestamp(utc_s, UTC)
    if kind == "SYSTEM_TIME":
        return svlog_mavlink(kind, time_unix_usec=round(utc_s * 1e6), time_boot_ms=5)
    date = when.strftime("%d%m%y" if kind == "RMC" else "%d,%m,%Y")
    clock = when.strftime("%H%M%S.") + f"{when.microsecond // 10_000:02}"
    text = f"$GN{kind},{clock},A,4824.0,N,06848.0,W,2.0,90.0,{date}" if kind == "RMC" else f"$GN{kind},{clock},{date},,"
    return svlog_packet(109, text.encode())


@pytest.mark.parametrize("kind", ["RMC", "ZDA", "SYSTEM_TIME"])
@pytest.mark.parametrize("off_s", [0.0, 1.5, 3600.0, -86_400.0 * 400])
def test_received_times_have_priority_over_a_date_that_differs(tmp_path, kind, off_s):
    true_s = START_S + off_s
    packets = []
    for row in range(60):
        packets += [received(kind, true_s + 0.1 * row)] if row % 10 == 0 else []
        packets += [profile(row, 10**6 + 100 * row, side) for side in (0, 1)]
    survey = read(tmp_path, session(uptime_s=1000.0), *packets)
    assert times_s(survey)[0] == (off_s if abs(off_s) > 2 else 0.0)
    assert has_note(survey, f"the session has a date that is {-off_s:+.0f} s off") is (abs(off_s) > 2)
    survey = read(tmp_path, session(uptime_s=None), *packets)
    assert has_note(survey, "another clock") is False, "the received times confirm the date"
    survey = read(tmp_path, *packets)
    assert times_s(survey)[0] == off_s
    assert has_note(survey, "right to about 1 s: the session has no date")


def test_received_times_that_do_not_advance_are_ignored(tmp_path):
    for step_s in (0.0, -0.1, 100.0):
        packets = [
            packet
            for row in range(60)
            for packet in (received("RMC", START_S - 5000 + step_s * row), profile(row, 10**6 + 100 * row, 0))
        ]
        assert times_s(read(tmp_path, session(), *packets))[::59] == [0.0, 5.9]


def test_sessions_have_their_own_dates_and_pings(tmp_path):
    first, second = START_S, START_S + 7200
    packets = [
        session(first),
        profile(5, 10**6, 0),
        session(second, 1000.0),
        profile(5, 10**6, 1),
        profile(6, 1_000_050, 1),
    ]
    survey = read(tmp_path, *packets)
    assert times_s(survey) == [0.0, 7200.0, 7200.05]
    assert [len(ping.channels) for ping in survey] == [1, 1, 1]
    # A copy of a session packet, and one without a date, begin no session.
    other = svlog_packet(10, b'{"device": 1}')
    pings = [profile(n, 10**6 + 50 * n, side) for n in range(4) for side in (0, 1)]
    survey = read(tmp_path, session(), pings[0], session(), other, *pings[1:])
    assert (times_s(survey), {len(ping.channels) for ping in survey}) == ([0.0, 0.05, 0.1, 0.15], {2})
    assert has_note(survey, "ignored session packet: no timestamp (1 times)")
    # Without a date before them, profiles are left out.
    survey = read(tmp_path, *pings[:4], svlog_session("yesterday"), session(second), *pings[4:])
    assert times_s(survey) == [7200.1, 7200.15]
    assert has_note(survey, "left out profile without a date (4 times)")


@pytest.mark.parametrize(("last_s", "clock_s"), [(3000, 0.5), (3000, 20.0), (25, 3.0)])
@pytest.mark.parametrize("elapsed_s", [0, 45])
def test_restart_of_the_sonars_continues_the_time(tmp_path, last_s, clock_s, elapsed_s):
    sonar = Sonar()
    before, after = sonar.packets(0, 20, 1000 * last_s), sonar.packets(1, 20, 1000 * clock_s, first_number=0)
    boots = [svlog_position(48.4, -68.8, 90.0, 1.0, 1000 * (70 + each)) for each in (0, elapsed_s)]
    survey = read(tmp_path, session(uptime_s=last_s - 1), boots[0], *before, boots[1], *after)
    assert [{mark_of(channel) for channel in ping.channels} for ping in survey] == [
        {(part, row)} for part in (1, 2) for row in range(1, 21)
    ]
    assert times_s(survey)[19:21] == pytest.approx([1.95, 1.958 + (elapsed_s or clock_s)], abs=0.01)
    text = "right to about 1 s, by the MAVLink messages" if elapsed_s else "early by the unknown time that it was off"
    assert has_note(survey, f"a sonar restarts: times after it are {text}")


def test_restart_of_one_sonar_keeps_the_clock_of_the_other(tmp_path):
    packets = []
    for row in range(60):
        packets.append(profile(row, 3_000_000 + 50 * row, 0, (1, row + 1)))
        if row < 20:
            packets.append(profile(row, 3_000_008 + 50 * row, 1, (1, row + 1)))
        elif row >= 30:
            packets.append(profile(row - 30, 2000 + 50 * (row - 30), 1, (1, row + 1)))
    survey = read(tmp_path, session(uptime_s=3000.0), *packets)
    assert {mark_of(ping.channel(Side.PORT))[1]: ping.time_utc_s for ping in survey if ping.channel(Side.PORT)} == {
        row + 1: pytest.approx(START_S + 0.05 * row, abs=0.001) for row in range(60)
    }
    assert sum(len(ping.channels) == 1 for ping in survey) <= 12
    for ping in survey:
        rows = [mark_of(channel)[1] for channel in ping.channels]
        assert max(rows) - min(rows) <= 1, "the clock of the restarted sonar is known to about an interval"


def test_single_glitch_of_the_clock_is_no_restart(tmp_path):
    packets = Sonar().packets(0, 20, 10**6)
    packets[10:12] = [profile(105, 970_000, side, (1, 6)) for side in (0, 1)]
    survey = read(tmp_path, session(), *packets)
    assert times_s(survey)[4:7] == [0.2, -30.0, 0.3]
    assert has_note(survey, "time goes back in 1 of 20 pings, the first in row 5")


@pytest.mark.parametrize("batch", [1, 10])
@pytest.mark.parametrize("is_wrong", [False, True])
def test_positions_are_interpolated_between_messages(tmp_path, batch, is_wrong):
    """A wrong position, of the fourth second, is not that of pings before the message."""
    packets = []
    for first in range(0, 160, batch):
        if first % 20 == 0:
            lat_deg = 48.4 + 1e-5 * first / 20 + (is_wrong and first == 80)
            packets.append(svlog_position(lat_deg, 179.9999, 0.0, 1.0))
        packets += [profile(row, 10**6 + 50 * row, side) for side in (0, 1) for row in range(first, first + batch)]
    pings = read(tmp_path, session(), *packets).pings
    off_deg = [
        None if ping.lat_deg is None else ping.lat_deg - 48.4 - 1e-5 * row / 20 for row, ping in enumerate(pings)
    ]
    assert len(off_deg) == 160
    # Up to the last message, and the wrong one, positions are those of the times; after them they are held.
    right = off_deg[:61] + off_deg[105:141] if is_wrong else off_deg[:141]
    assert max(map(abs, right)) < 1e-7
    assert max(map(abs, off_deg[61:80] + off_deg[141:])) < 1e-5


@given(
    place=st.floats(0, 1),
    size=st.integers(0, 3000),
    kind=st.sampled_from(("delete", "insert", "overwrite")),
    seed=st.integers(0, 99),
)
def test_damage_in_batches_is_local(tmp_path_factory, place, size, kind, seed):
    """Profiles outside a damaged span are read, and none is invented."""
    packets = [session(), *Sonar(batch=3, lead=4).packets(0, 40, 1_000_500)]
    marks = [None] + [
        (1 + row + first, side) for first in range(0, 40, 3) for side in SIDES for row in range(min(3, 40 - first))
    ]
    starts = np.cumsum([0, *map(len, packets)]).tolist()
    raw = b"".join(packets)
    first = round(starts[1] + place * (len(raw) - starts[1]))
    end = first if kind == "insert" else min(first + size, len(raw))
    new = b"" if kind == "delete" else np.random.default_rng(seed).bytes(size if kind == "insert" else end - first)
    path = tmp_path_factory.mktemp("svlog") / "line.svlog"
    path.write_bytes(raw[:first] + new + raw[end:])
    found = {
        (mark_of(channel)[1], channel.side): ping.time_utc_s - START_S
        for ping in read_survey(path)
        for channel in ping.channels
    }
    kept = {
        m for m, start, stop in zip(marks, starts, starts[1:], strict=False) if m and (stop <= first or start >= end)
    }
    assert kept <= set(found) <= set(marks)
    assert all(abs(time_s - 0.5 - 0.05 * (row - 1)) < 0.01 for (row, _), time_s in found.items())


def test_memory_is_bounded_by_the_pings_that_wait(tmp_path):
    """A transducer of which the other side is missing does not hold its pings back for ever."""
    packets = [profile(row, 10**6 + 50 * row, 0, (1, row + 1)) for row in range(1000)]
    path = tmp_path / "line.svlog"
    path.write_bytes(session() + b"".join(packets) + profile(0, 10**6 + 8, 1, (1, 1)))
    with open_survey(path) as source:
        pings = list(source.pings())
    assert len(pings) == 1001
    assert all(b.time_utc_s > a.time_utc_s for a, b in pairwise(pings[:1000]))
    assert datetime.fromtimestamp(pings[999].time_utc_s, UTC) == START + timedelta(seconds=49.95)
