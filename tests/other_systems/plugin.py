"""Pytest on an imitated system: ``LODESTREAM_IMITATED=win32 pytest -p tests.other_systems.plugin``.

It shows that the tests without a server are collected where there is no server, and that the others are skipped. What
other libraries do on such a system it cannot show.
"""

from __future__ import annotations

import os

from tests.other_systems.imitation import imitate

imitate(os.environ["LODESTREAM_IMITATED"], also_tests=True)
