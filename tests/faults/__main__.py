"""``python -m tests.faults [WORDS]``: every case whose name contains the words, or with ``--list`` only their names.

``python -m tests.faults 'repair, flipped upload' --seconds 300``
``python -m tests.faults upload 'fsync surfaces' --part 0.2``

All of them take some time. With ``--journal FILE`` each run goes on where the last one with that file has ended.
"""

from __future__ import annotations

import argparse
import signal
import sys
import tempfile
from pathlib import Path

from .run import SCENARIOS, Session, in_memory, run


def main() -> int:
    """Run them; 1 when one shows a problem."""
    parser = argparse.ArgumentParser(prog="python -m tests.faults", description=__doc__)
    parser.add_argument(
        "words", nargs="*", help="what a case's name contains, all of them; all cases when none is given"
    )
    parser.add_argument(
        "--scenario", choices=SCENARIOS, action="append", help="only cases of this one; may be repeated"
    )
    parser.add_argument("--list", action="store_true", help="print the names")
    parser.add_argument("--part", type=float, default=1.0, help="what part of them, drawn at random (default: 1)")
    parser.add_argument("--seed", type=int, default=1, help="for drawing them (default: 1)")
    parser.add_argument("--seconds", type=float, help="the longest time that it may take")
    parser.add_argument("--journal", type=Path, help="a file of what was tried; what it has is not tried again")
    parser.add_argument("--sessions", type=int, help="how many are tried at the same time (default: processors + 1)")
    args = parser.parse_args()
    scenarios = args.scenario or SCENARIOS
    signal.signal(signal.SIGTERM, signal.default_int_handler)  # so that nothing stays in memory
    if args.list:
        with tempfile.TemporaryDirectory(dir=in_memory()) as folder, Session(Path(folder)) as session:
            names = [str(case) for case in session.everything(scenarios)]
        print("\n".join(name for name in names if all(word in name for word in args.words)))
        return 0
    report = run(
        args.part,
        args.seconds,
        seed=args.seed,
        scenarios=scenarios,
        chosen=lambda case: all(word in str(case) for word in args.words),
        journal=args.journal,
        sessions=args.sessions,
    )
    print("\n".join(map(str, report.problems)))
    print("\n".join(report.facts()))
    return 1 if report.problems else 0


if __name__ == "__main__":
    sys.exit(main())
