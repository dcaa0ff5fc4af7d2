"""Build the documentation site: ``python .ci/docs.py FOLDER`` needs the group ``docs`` of pyproject.toml.

The pages are copied with the folders that they stand in, so that their links lead where they lead on GitHub, and Sphinx
makes HTML of the copy. A warning, such as a link that leads nowhere, is an error.
"""

from __future__ import annotations

import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent

#: Pages, and what they link to.
PARTS = ("README.md", "CONTRIBUTING.md", "SECURITY.md", "CHANGELOG.md", "LICENSE", "docs", "client/web/README.md")
MORE = ("client/web/examples",)
SETTINGS = ROOT / "docs" / "site"


def main(out: Path) -> int:
    """Build the site into a folder, which is replaced; return Sphinx's exit code."""
    shutil.rmtree(out, ignore_errors=True)
    with tempfile.TemporaryDirectory() as name:
        pages = Path(name) / "pages"
        for part in (*PARTS, *MORE):
            copy = pages / part
            copy.parent.mkdir(parents=True, exist_ok=True)
            if (ROOT / part).is_dir():
                shutil.copytree(ROOT / part, copy, ignore=shutil.ignore_patterns("site"))
            else:
                shutil.copy(ROOT / part, copy)
        shutil.copy(SETTINGS / "index.md", pages)
        command = [sys.executable, "-m", "sphinx", "--quiet", "--fail-on-warning", "--jobs", "2", "-d", f"{name}/state"]
        return subprocess.run([*command, "-c", str(SETTINGS), str(pages), str(out)], check=False).returncode


if __name__ == "__main__":
    if len(sys.argv) != 2:
        sys.exit("usage: python .ci/docs.py FOLDER")
    sys.exit(main(Path(sys.argv[1])))
