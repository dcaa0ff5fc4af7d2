"""The window on links of every kind: full where the link is fast, small where it is slow."""

from __future__ import annotations

import heapq
from dataclasses import dataclass

import pytest
from hypothesis import given
from hypothesis import strategies as st

from lodestream.errors import OptionError
from lodestream.protocol.flow_control import FIRST_WINDOW, SMALL_MESSAGE, FlowWindow
from lodestream.protocol.messages import BASE_CREDIT, MAX_CREDIT, MAX_DATA, MIN_WINDOW


@dataclass
class Outcome:
    """How a transfer went: the share of the link's rate that was used; the most outstanding, and in its second half."""

    use: float
    most: int
    settled: int
    window: FlowWindow


def transfer(
    rate: float,
    round_trip: float,
    total: int,
    *,
    burst: float = 0.0,
    share: int = 16,
    most_credit: int = MAX_CREDIT,
    work: float = 0.0,
    told: bool = True,
    first: int = FIRST_WINDOW,
) -> Outcome:
    """Receive so many bytes over a link that lets nothing through but every ``burst`` seconds.

    The server keeps so much credit, and sends messages of a share of the most that there was. The client computes so
    many seconds for each byte, and tells how long it waited for messages in between.
    """
    window = FlowWindow(first=first)
    window.allow(most_credit)
    outstanding = credit = window.size
    window.grant(window.size, 0.0)
    window.heard(round_trip)
    window.began(0.0, round_trip)
    events: list[tuple[float, int, str, int]] = []
    free = now = sent = most = settled = 0.0
    ready = round_trip
    count = largest = 0

    def send(now: float) -> None:
        nonlocal credit, free, sent, count, largest
        while credit and sent < total:
            largest = max(largest, credit)
            size = int(min(credit, max(largest // share, SMALL_MESSAGE), MAX_DATA, total - sent))
            free = max(free, now) + size / rate
            due = -(-free // burst) * burst if burst else free
            heapq.heappush(events, (due + round_trip / 2, count, "data", size))
            credit, sent, count = credit - size, sent + size, count + 1

    send(round_trip / 2)
    while events:
        now, _, kind, size = heapq.heappop(events)
        if kind == "grant":
            credit = min(credit + size, most_credit)
            send(now)
            continue
        assert outstanding <= window.size or outstanding <= most, "no grant goes beyond the window"
        waited, now = max(now - ready, 0.0), max(now, ready)
        ready = now + work * size
        outstanding -= size
        if told:
            window.waited(waited)
        window.arrive(size, now)
        if grant := window.due(outstanding):
            window.grant(grant, now)
            outstanding += grant
            heapq.heappush(events, (ready + round_trip / 2, count, "grant", grant))
            count += 1
        most = max(most, outstanding)
        settled = max(settled, outstanding) if sent > total / 2 else 0
    return Outcome(total / now / rate, int(most), int(settled), window)


@pytest.mark.parametrize("round_trip", [0.001, 0.02, 0.1, 0.3])
@pytest.mark.parametrize("rate", [8e3, 32e3, 125e3, 1.25e6])
def test_a_link_is_kept_busy_by_little_more_than_it_holds(rate: float, round_trip: float) -> None:
    outcome = transfer(rate, round_trip, round(rate * 60))
    product = rate * round_trip
    enough = 1.1 * (product + 0.005 * rate) + 2.5 * SMALL_MESSAGE
    assert outcome.most <= max(FIRST_WINDOW, enough, 2.2 * product)
    assert outcome.settled <= max(MIN_WINDOW, enough)
    assert outcome.use > 0.95


@pytest.mark.parametrize(("rate", "round_trip"), [(12.5e6, 0.1), (12.5e6, 0.02), (125e6, 0.02)])
def test_a_fast_link_is_filled_soon_by_no_more_than_1_2_times_what_it_holds(rate: float, round_trip: float) -> None:
    outcome = transfer(rate, round_trip, round(4 * rate))
    assert outcome.use > 0.85
    assert outcome.settled <= 1.2 * rate * max(round_trip, 0.1)


@pytest.mark.parametrize(("rate", "round_trip"), [(125e3, 0.3), (625e3, 0.1), (1.25e6, 0.1), (2e6, 0.1)])
def test_a_server_of_an_earlier_release_is_kept_busy_too(rate: float, round_trip: float) -> None:
    outcome = transfer(rate, round_trip, round(rate * 30), share=4, most_credit=BASE_CREDIT)
    assert outcome.use > 0.95


@pytest.mark.parametrize("round_trip", [0.005, 0.02, 0.1, 0.3])
@pytest.mark.parametrize("rate", [1.25e6, 12.5e6, 125e6])
def test_a_client_that_computes_for_long_is_kept_busy_by_no_more_than_it_needs(rate: float, round_trip: float) -> None:
    work = 2.5e-7
    total, used = 20_000_000, min(rate, 1 / work)
    outcome = transfer(rate, round_trip, total, work=work)
    assert total / rate / outcome.use <= 1.02 * total / used + 5 * round_trip
    assert outcome.settled <= max(MIN_WINDOW, 1.5 * used * (round_trip + 0.01) + 2.5 * SMALL_MESSAGE)


@pytest.mark.parametrize("told", [False, True])
@pytest.mark.parametrize("work", [0.0, 2.5e-7])
@pytest.mark.parametrize("rate", [8e3, 32e3, 125e3, 1.25e6, 12.5e6, 125e6])
@pytest.mark.parametrize("round_trip", [0.005, 0.02, 0.1])
def test_waits_that_nobody_tells_cost_no_more_than_some_round_trips(
    rate: float, round_trip: float, work: float, told: bool
) -> None:
    total = round(min(rate * 20, 5e6))
    outcome = transfer(rate, round_trip, total, work=work, told=told)
    seconds = total / rate / outcome.use
    assert seconds <= 1.02 * max(total / rate, total * work) + 8 * round_trip
    assert outcome.most <= max(FIRST_WINDOW, 4 * rate * (round_trip + 0.005) + 2.5 * SMALL_MESSAGE)


@pytest.mark.parametrize(("rate", "growth"), [(1e12, 16), (12.5e6, 16), (1.25e6, 4), (0.7e6, 2.1)])
def test_the_first_window_grows_to_what_the_link_would_have_carried(rate: float, growth: float) -> None:
    window = FlowWindow()
    window.allow(MAX_CREDIT)
    window.heard(0.1)
    window.began(0.0, 0.1)
    now = 0.1
    for _ in range(FIRST_WINDOW // SMALL_MESSAGE):
        now += SMALL_MESSAGE / rate
        window.waited(SMALL_MESSAGE / rate)
        window.arrive(SMALL_MESSAGE, now)
    assert window.size == pytest.approx(growth * FIRST_WINDOW, rel=0.1)
    assert window.size <= max(2 * rate * 0.1, 16 * FIRST_WINDOW)


def test_a_link_that_becomes_faster_is_filled_again() -> None:
    window = FlowWindow()
    window.allow(MAX_CREDIT)
    window.heard(0.1)
    now = 0.0
    for rate in (1e5, 1e7):
        for _ in range(2000):
            window.arrive(SMALL_MESSAGE, now)
            # A window goes out in a round trip, or at the rate of the link.
            now += SMALL_MESSAGE / min(rate, window.size / 0.1)
    assert window.size > 1e6


@pytest.mark.parametrize("round_trip", [0.001, 0.02, 0.1, 0.3])
@pytest.mark.parametrize("burst", [0.0, 0.1, 0.5, 2.0])
def test_on_256_kbit_per_second_no_more_than_32_kib_are_under_way(round_trip: float, burst: float) -> None:
    outcome = transfer(32e3, round_trip, 1_000_000, burst=burst)
    assert outcome.most <= 32 * 1024


@pytest.mark.parametrize("round_trip", [0.005, 0.02, 0.1])
@pytest.mark.parametrize("rate", [12.5e6, 125e6])
def test_a_window_that_is_known_saves_round_trips(rate: float, round_trip: float) -> None:
    total = 300_000
    cold = transfer(rate, round_trip, total)
    assert cold.window.measured
    warm = transfer(rate, round_trip, total, first=cold.window.size)
    saved = total / rate * (1 / cold.use - 1 / warm.use) / round_trip
    assert saved > 0.3


@pytest.mark.parametrize("rate", [8e3, 32e3, 125e3])
def test_a_window_that_is_known_of_a_faster_link_lasts_until_it_has_come_once(rate: float) -> None:
    outcome = transfer(rate, 0.05, 2_000_000, first=MAX_CREDIT)
    assert outcome.most == BASE_CREDIT
    assert outcome.settled <= max(MIN_WINDOW, 1.1 * rate * 0.06) + BASE_CREDIT // 16  # of the largest message
    assert outcome.use > 0.95


def test_a_first_window_stays_within_what_every_server_keeps() -> None:
    assert FlowWindow(first=MAX_CREDIT).size == BASE_CREDIT
    assert FlowWindow(first=1).size == MIN_WINDOW
    assert FlowWindow(50_000, first=MAX_CREDIT).size == 50_000


def test_it_is_measured_when_a_whole_window_has_come_and_never_where_it_is_fixed() -> None:
    for window, last in ((FlowWindow(first=40_000), True), (FlowWindow(40_000), False)):
        window.heard(0.01)
        window.began(0.0, 0.01)
        window.arrive(38_000, 0.02)
        assert not window.measured
        window.arrive(2_000, 0.03)
        assert window.measured is last


def test_a_link_without_limits_gets_all_that_is_allowed() -> None:
    outcome = transfer(1e12, 0.05, 20_000_000)
    assert outcome.window.size == MAX_CREDIT


@given(
    st.lists(st.tuples(st.integers(1, MAX_DATA), st.floats(0, 10), st.none() | st.floats(0, 10)), max_size=50),
    st.none() | st.floats(1e-9, 100),
    st.integers(BASE_CREDIT, MAX_CREDIT),
    st.booleans(),
)
def test_it_stays_within_its_limits_and_always_grants_more_whatever_comes(
    arrivals: list[tuple[int, float, float | None]], heard: float | None, most: int, timed: bool
) -> None:
    window, now = FlowWindow(), 0.0
    window.allow(most)
    if heard is not None:
        window.heard(heard)
    if timed:
        window.began(0.0, heard or 0.0)
    outstanding = window.size
    window.grant(outstanding)
    for size, seconds, waited in arrivals:
        now += seconds
        if waited is not None:
            window.waited(waited)
        came = min(size, outstanding)
        outstanding -= came
        window.arrive(came, now)
        assert MIN_WINDOW <= window.size <= most
        if grant := window.due(outstanding):
            window.grant(grant, now)
            outstanding += grant
            assert outstanding <= window.size
        assert outstanding, "the stream goes on"


@given(st.none() | st.integers(1, MAX_CREDIT), st.integers(0, MAX_CREDIT))
def test_a_grant_never_goes_beyond_the_window_and_always_comes(fixed: int | None, credit: int) -> None:
    window = FlowWindow(fixed)
    assert credit + window.due(credit) <= max(window.size, credit)
    assert window.due(0) == window.size


def test_without_times_it_stays_as_it_is() -> None:
    window = FlowWindow()
    for _ in range(100):
        window.grant(MAX_DATA)
        window.arrive(MAX_DATA)
    assert window.size == FIRST_WINDOW


@pytest.mark.parametrize("size", [1, 1000, BASE_CREDIT, MAX_CREDIT])
def test_a_fixed_one_is_not_measured(size: int) -> None:
    window = FlowWindow(size)
    assert window.size == min(size, BASE_CREDIT)  # every server keeps as much
    window.allow(MAX_CREDIT)
    for number in range(100):
        window.grant(size, float(number))
        window.arrive(size, number + 1e-3)
    assert window.size == size


@pytest.mark.parametrize("size", [0, -1, MAX_CREDIT + 1])
def test_a_size_outside_the_limits_is_refused(size: int) -> None:
    with pytest.raises(OptionError, match="window"):
        FlowWindow(size)
