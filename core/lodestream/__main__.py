"""``python -m lodestream``: the command ``lodestream``, where its program is installed.

The program belongs to the client, which stands above this package. So it is found by the name under which it was
installed, as a shell finds it.
"""

from __future__ import annotations

import sys
from importlib.metadata import entry_points

__all__ = ["main"]


def main() -> int:
    """Run the command and return its exit code; 1 where the client is not installed."""
    found = next(iter(entry_points(group="console_scripts", name="lodestream")), None)
    if found is None:
        print("lodestream: the command is not installed: pip install lodestream", file=sys.stderr)
        return 1
    code: int = found.load()()
    return code


if __name__ == "__main__":
    sys.exit(main())
