"""What a notebook shows of a stream."""

from __future__ import annotations

import lodestream as ls
from lodestream_client import Client


def test_a_stream_shows_what_has_come_and_its_last_view(surface: str) -> None:
    with Client(surface).connect(surface, target=ls.Target(level=3)) as stream:
        before = stream._repr_html_()
        for _ in stream:
            pass
        after = stream._repr_html_()
    assert surface in before
    assert "receiving" in before
    assert f"{stream.received:,} of {stream.planned:,} bytes" in after
    assert "level" in after
    assert "data:image/png;base64," in after
    assert f"{stream.decoder.view().rms:.4g}" in after
