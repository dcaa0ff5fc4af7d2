"""Entry point of the command ``lodestream``; nothing else is loaded before Ctrl-C is handled (`starting`)."""

from __future__ import annotations

import sys

from .starting import INTERRUPTED, TYPE_CHECKING, EndingAtOnce

if TYPE_CHECKING:
    from collections.abc import Sequence

__all__ = ["main"]


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command and return its exit code, see `lodestream_client.program.main`."""
    try:
        with EndingAtOnce():
            from . import program
        return program.main(argv)
    except KeyboardInterrupt:
        return INTERRUPTED


if __name__ == "__main__":
    sys.exit(main())
