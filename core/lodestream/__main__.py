"""``python -m lodestream``: the command ``lodestream``, where its program is installed.

The program belongs to the client, which is layered above this package. So it is looked up by the name of its entry
point, as a shell does.
"""

from __future__ import annotations

import sys
from importlib.metadata import entry_points

__all__ = ["main"]


def main() -> int:
    """Run the command and return its exit code; 1 where the client is not installed."""
    entry_point = next(iter(entry_points(group="console_scripts", name="lodestream")), None)
    if entry_point is None:
        print("lodestream: the command is not installed: pip install lodestream", file=sys.stderr)
        return 1
    code: int = entry_point.load()()
    return code


if __name__ == "__main__":
    sys.exit(main())
