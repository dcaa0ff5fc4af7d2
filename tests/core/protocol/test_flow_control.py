"""The window on links of every kind: full where the link is fast, small where it is slow."""

from __future__ import annotations

import heapq
from dataclasses import dataclass

import pytest
from hypothesis import given
from hypothesis import strategies as st

from lodestream.errors import OptionError
from lodestream.protocol.flow_control import FlowWindow
from lodestream.protocol.messages import MAX_CREDIT, MAX_DATA, MIN_WINDOW


@dataclass
class Outcome:
    """How a transfer went: the share of the link's rate that was used, and the most that was outstanding."""

    use: float
    most: int
    window: FlowWindow


def transfer(rate: float, round_trip: float, total: int, burst: float = 0.0) -> Outcome:
    """Receive so many bytes over a link that lets nothing through but every ``burst`` seconds."""
    window = FlowWindow()
    outstanding = credit = window.size
    window.grant(window.size, 0.0)
    window.heard(round_trip)
    events: list[tuple[float, int, str, int]] = []
    free = now = sent = most = 0.0
    count = 0

    def send(now: float) -> None:
        nonlocal credit, free, sent, count
        while credit and sent < total:
            size = int(min(credit, max(credit // 4, 4096), MAX_DATA, total - sent))
            free = max(free, now) + size / rate
            due = -(-free // burst) * burst if burst else free
            heapq.heappush(events, (due + round_trip / 2, count, "data", size))
            credit, sent, count = credit - size, sent + size, count + 1

    send(round_trip / 2)
    while events:
        now, _, kind, size = heapq.heappop(events)
        if kind == "grant":
            credit += size
            send(now)
            continue
        outstanding -= size
        window.arrive(size, now)
        grant = window.size - outstanding
        if grant > 0 and grant * 4 >= window.size:
            window.grant(grant, now)
            outstanding += grant
            heapq.heappush(events, (now + round_trip / 2, count, "grant", grant))
            count += 1
        most = max(most, outstanding)
    return Outcome(total / now / rate, int(most), window)


@pytest.mark.parametrize("round_trip", [0.001, 0.02, 0.1, 0.3])
@pytest.mark.parametrize("rate", [8e3, 32e3, 125e3, 1.25e6])
def test_a_link_is_kept_busy_by_little_more_than_it_holds(rate: float, round_trip: float) -> None:
    outcome = transfer(rate, round_trip, round(rate * 60))
    assert outcome.most <= max(MIN_WINDOW, 2.5 * rate * round_trip)
    assert outcome.use > min(0.9, 0.7 * MAX_CREDIT / (rate * round_trip))


@pytest.mark.parametrize("round_trip", [0.001, 0.02, 0.1, 0.3])
@pytest.mark.parametrize("burst", [0.0, 0.1, 0.5, 2.0])
def test_on_256_kbit_per_second_no_more_than_32_kib_are_under_way(round_trip: float, burst: float) -> None:
    outcome = transfer(32e3, round_trip, 1_000_000, burst)
    assert outcome.most <= 32 * 1024


def test_a_link_without_limits_gets_all_that_is_allowed() -> None:
    outcome = transfer(1e12, 0.05, 20_000_000)
    assert outcome.window.size == MAX_CREDIT


@given(
    st.lists(st.tuples(st.integers(1, MAX_DATA), st.floats(0, 10)), max_size=50),
    st.none() | st.floats(1e-9, 100),
)
def test_it_stays_within_its_limits_whatever_comes(arrivals: list[tuple[int, float]], heard: float | None) -> None:
    window, now = FlowWindow(), 0.0
    if heard is not None:
        window.heard(heard)
    for size, seconds in arrivals:
        now += seconds
        window.grant(size, now)
        window.arrive(size, now)
        assert MIN_WINDOW <= window.size <= MAX_CREDIT


def test_without_times_it_stays_as_it_is() -> None:
    window = FlowWindow()
    for _ in range(100):
        window.grant(MAX_DATA)
        window.arrive(MAX_DATA)
    assert window.size == MIN_WINDOW


@pytest.mark.parametrize("size", [1, 1000, MAX_CREDIT])
def test_a_fixed_one_is_not_measured(size: int) -> None:
    window = FlowWindow(size)
    for number in range(100):
        window.grant(size, float(number))
        window.arrive(size, number + 1e-3)
    assert window.size == size


@pytest.mark.parametrize("size", [0, -1, MAX_CREDIT + 1])
def test_a_size_outside_the_limits_is_refused(size: int) -> None:
    with pytest.raises(OptionError, match="window"):
        FlowWindow(size)
