"""A hundred random schedules of links that break; ``make torture`` runs ten thousand and more of them."""

from __future__ import annotations

import pytest

from tests.torture import streams


@pytest.mark.long
def test_whatever_a_link_does_the_surface_is_the_same_in_the_end() -> None:
    report = streams.run(100)
    assert report.problems == []
    assert report.identical + report.errors.total() == report.schedules >= 100
    assert report.identical > 80
    assert report.connections > 140, "links were to break"
