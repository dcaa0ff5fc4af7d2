"""``python -m tests.history``: one history, of some kinds of disasters only, and everything that is wrong in it.

``--kinds kill,full --count 10 --seed 3 --no-owners`` says which, how many, of which chance, and without tokens.
``--again FILE`` judges one that was kept, as `tests.torture.takeovers` does when something is wrong.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from pathlib import Path

from tests.torture import history

from .checker import check
from .disasters import KINDS
from .events import History


def main() -> int:
    """Run; 1 when something is wrong."""
    parser = argparse.ArgumentParser(prog="python -m tests.history", description=__doc__)
    parser.add_argument("--kinds", default=",".join(history.possible()), help=f"of {', '.join(KINDS)} (default: all)")
    parser.add_argument("--count", type=int, default=12, help="disasters (default: 12)")
    parser.add_argument("--seconds", type=float, help="the most that it may take, without what ends it")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--owners", action=argparse.BooleanOptionalAction, default=True, help="tokens and owners")
    parser.add_argument("--longest", type=float, default=1.5, help="most seconds between two things that happen")
    parser.add_argument("--again", type=Path, metavar="FILE", help="judge the history in this file")
    args = parser.parse_args()
    if args.again is not None:
        return _again(args.again)
    kinds = args.kinds.split(",")
    unknown = sorted(set(kinds) - KINDS.keys())
    if unknown:
        parser.error(f"expected kinds of {', '.join(KINDS)}, got {', '.join(unknown)}")
    with tempfile.TemporaryDirectory() as folder:
        done = history.run(
            Path(folder),
            args.count,
            args.seconds,
            seed=args.seed,
            kinds=kinds,
            owners=args.owners,
            longest=args.longest,
        )
    for finding in done.findings:
        print(finding)
    print(
        f"{done.operations} operations in {done.seconds:.0f} s, {done.unanswered} of them without an answer: "
        f"{done.uploads} uploads, {done.deletes} deletes, {done.pointed} changes of names, "
        f"{done.reads} reads, {done.refused} refused for lack of room; "
        f"{dict(done.disasters)}; {done.ready} surfaces at the end; {len(done.findings)} findings"
    )
    return 1 if done.findings else 0


def _again(file: Path) -> int:
    """Judge what was kept."""
    kept = History.read(file)
    findings = check(kept, lambda told: print(told, flush=True))
    for finding in findings:
        print(finding)
    print(f"{len(kept.operations)} operations; {len(findings)} findings")
    return 1 if findings else 0


if __name__ == "__main__":
    sys.exit(main())
