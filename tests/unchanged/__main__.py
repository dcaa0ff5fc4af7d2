"""Record digests of surfaces, or compare: ``python -m tests.unchanged record FOLDER``, later ``... compare FOLDER``."""

from __future__ import annotations

import argparse
import json
import pickle
import sys
import warnings
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from itertools import chain
from pathlib import Path

import lodestream as ls

from .cases import Case, array_cases, file_cases, random_case
from .digests import digests

SHARED = Path(__file__).parents[2].parent / "shared"


def digests_of(path: Path) -> dict[str, str]:
    """Encode a surface that was kept, and digest its container; of one that is refused, return the error."""
    case: Case = pickle.loads(path.read_bytes())  # of this program's own making
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            return digests(ls.encode(case.surface, **case.options))
        except ls.LodestreamError as error:
            return {"error": f"{type(error).__name__}: {error}"}


def cases(count: int) -> Iterator[Case]:
    """Give ``count`` random surfaces, and those of the shared folder where it is there."""
    yield from map(random_case, range(count))
    if SHARED.is_dir():
        yield from chain(file_cases(SHARED / "data"), array_cases())


def main() -> int:
    """Return 1 where something differs."""
    parser = argparse.ArgumentParser(prog="python -m tests.unchanged", description=__doc__)
    parser.add_argument("action", choices=["record", "compare"])
    parser.add_argument("folder", type=Path)
    parser.add_argument("--count", type=int, default=400, help="random surfaces to record")
    chosen = parser.parse_args()
    expected = chosen.folder / "expected.json"
    if chosen.action == "record":
        chosen.folder.mkdir(parents=True)
        for case in cases(chosen.count):
            (chosen.folder / f"{case.name}.pickle").write_bytes(pickle.dumps(case))
    paths = sorted(chosen.folder.glob("*.pickle"))
    with ProcessPoolExecutor() as executor:
        results = {path.stem: result for path, result in zip(paths, executor.map(digests_of, paths), strict=True)}
    if chosen.action == "record":
        expected.write_text(json.dumps(results, indent=1, sort_keys=True))
        print(f"{len(results)} surfaces recorded in {chosen.folder}")
        return 0
    before = json.loads(expected.read_text())
    differences = []
    for name, result in results.items():
        keys = sorted(key for key in {*before[name], *result} if before[name].get(key) != result.get(key))
        if keys:
            differences.append(f"{name}: {', '.join(keys)}")
    print(*differences, f"{len(results)} surfaces compared, {len(differences)} differ", sep="\n")
    return 1 if differences else 0


if __name__ == "__main__":
    sys.exit(main())
