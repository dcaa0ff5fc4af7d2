"""Print how many lines of Python each package has, as a table: code, docstrings, comments. Nothing is refused."""

from __future__ import annotations

import ast
import tokenize
from collections import Counter
from pathlib import Path

ROOT = Path(__file__).parents[1]
#: Folders whose packages are counted one by one, and folders that are counted as a whole.
DIVIDED = ("core/lodestream", "client/lodestream_client", "server/lodestream_server")
WHOLE = ("tests", "benchmarks")
COLUMNS = ("files", "code", "docstrings", "comments")
#: Tokens that are no code.
LAYOUT = {tokenize.ENCODING, tokenize.NL, tokenize.NEWLINE, tokenize.INDENT, tokenize.DEDENT, tokenize.ENDMARKER}


def count(path: Path) -> Counter[str]:
    """Count the lines of a module: a line with code and a comment is code; blank lines are not counted."""
    docstrings: set[int] = set()
    for node in ast.walk(ast.parse(path.read_bytes())):
        if (
            isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef)
            and ast.get_docstring(node, clean=False) is not None
        ):
            docstrings.update(range(node.body[0].lineno, (node.body[0].end_lineno or 0) + 1))
    code: set[int] = set()
    comments: set[int] = set()
    with path.open("rb") as file:
        for token in tokenize.tokenize(file.readline):
            if token.type == tokenize.COMMENT:
                comments.add(token.start[0])
            elif token.type not in LAYOUT:
                code.update(range(token.start[0], token.end[0] + 1))
    code -= docstrings
    return Counter(files=1, code=len(code), docstrings=len(docstrings), comments=len(comments - code))


def table() -> dict[str, Counter[str]]:
    """Count the lines of each package, by its path; single modules of a folder are under the folder's own path."""
    lines: dict[str, Counter[str]] = {}
    for folder in DIVIDED + WHOLE:
        for path in sorted((ROOT / folder).rglob("*.py")):
            parts = path.relative_to(ROOT / folder).parts
            package = f"{folder}/{parts[0]}" if folder in DIVIDED and len(parts) > 1 else folder
            lines.setdefault(package, Counter()).update(count(path))
    return lines


def main() -> None:
    """Print the table and its sum."""
    lines = table()
    lines["sum"] = sum(lines.values(), Counter())
    width = max(map(len, lines))
    print(" " * width + "".join(f"{column:>12}" for column in COLUMNS))
    for package, counts in lines.items():
        print(f"{package:{width}}" + "".join(f"{counts[column]:12,}" for column in COLUMNS))


if __name__ == "__main__":
    main()
