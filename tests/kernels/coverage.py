"""Which lines of the kernels the tests have run, as gcov counts them."""

from __future__ import annotations

import json
import subprocess
from dataclasses import dataclass
from pathlib import Path

__all__ = ["Lines", "lines_run", "told"]


@dataclass(frozen=True)
class Lines:
    """Lines of a file that hold code, and those of them that never ran."""

    file: str
    count: int
    missing: tuple[int, ...]


def lines_run(objects: Path, sources: Path) -> list[Lines]:
    """What ran of the files in a folder of sources that were compiled with ``--coverage``.

    Parameters
    ----------
    objects : Path
        Where the object files are, and beside them what gcov has written since they were made.
    sources : Path

    Raises
    ------
    FileNotFoundError
        When nothing of it has run.
    """
    counts: dict[str, dict[int, int]] = {}
    data = sorted(objects.glob("*.gcda"))
    if not data:
        raise FileNotFoundError(f"expected counts of lines in {objects}, got none")
    # Also of what no process has run, which has notes but no counts.
    for notes in sorted(objects.glob("*.gcno")):
        command = ["gcov", "--json-format", "--stdout", str(notes)]
        said = subprocess.run(command, capture_output=True, text=True, check=True, cwd=objects).stdout
        for text in said.splitlines():
            for file in json.loads(text)["files"]:
                path = Path(file["file"])
                if path.parent.resolve() != sources.resolve():
                    continue
                lines = counts.setdefault(path.name, {})
                for line in file["lines"]:
                    number = line["line_number"]
                    lines[number] = lines.get(number, 0) + line["count"]
    return [
        Lines(name, len(lines), tuple(sorted(number for number, count in lines.items() if not count)))
        for name, lines in sorted(counts.items())
    ]


def told(found: list[Lines]) -> list[str]:
    """A line for each file that has lines which never ran, and one of all."""
    total, missing = sum(file.count for file in found), sum(len(file.missing) for file in found)
    lines = [f"{file.file}: never run: {_spans(file.missing)}" for file in found if file.missing]
    return [*lines, f"{total - missing:,} of {total:,} lines of C in {len(found)} files run by the tests"]


def _spans(numbers: tuple[int, ...]) -> str:
    spans: list[list[int]] = []
    for number in numbers:
        if spans and number == spans[-1][1] + 1:
            spans[-1][1] = number
        else:
            spans.append([number, number])
    return ", ".join(str(first) if first == last else f"{first}-{last}" for first, last in spans)
