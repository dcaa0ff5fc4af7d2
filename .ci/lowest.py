"""Run the tests with the oldest versions that pyproject.toml allows, in an environment of their own.

``python .ci/lowest.py FOLDER [PYTEST ARGUMENTS]`` makes FOLDER/.venv, where every requirement of the distribution
itself (not of its tests) stands at exactly its lower bound, and runs pytest there. Use the oldest Python supported.
"""

from __future__ import annotations

import re
import subprocess
import sys
import tomllib
import venv
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parent.parent


def constraints(project: dict[str, Any]) -> list[str]:
    """``name==bound`` for each ``name>=bound`` of the project's requirements and extras."""
    requirements: list[str] = list(project["dependencies"])
    for extra in project["optional-dependencies"].values():
        requirements += [requirement for requirement in extra if not requirement.startswith(f"{project['name']}[")]
    bounds = [re.fullmatch(r"([A-Za-z0-9-]+)>=([0-9.]+)", requirement) for requirement in requirements]
    missing = [r for r, bound in zip(requirements, bounds, strict=True) if bound is None]
    if missing:
        sys.exit(f"expected requirements of the form name>=version, got {', '.join(missing)}")
    return [f"{bound[1]}=={bound[2]}" for bound in bounds if bound]


def main(folder: Path, arguments: list[str]) -> int:
    """Make the environment, install, run the tests; the exit code is pytest's."""
    folder.mkdir(parents=True, exist_ok=True)
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    listed = folder / "constraints.txt"
    listed.write_text("\n".join(constraints(project)) + "\n")
    print(listed.read_text(), end="", flush=True)
    environment = folder.resolve() / ".venv"
    venv.create(environment, with_pip=True, clear=True)
    python = str(environment / "bin" / "python")
    pip = [python, "-m", "pip", "install", "--quiet", "--disable-pip-version-check"]
    subprocess.run([*pip, "--upgrade", "pip>=25.1"], check=True)
    group = ["--group", f"{ROOT}/pyproject.toml:test"]
    subprocess.run([*pip, "--constraint", str(listed), "--editable", f"{ROOT}[all]", *group], check=True)
    command = [python, "-m", "pytest", "-q", "-n", "2", "--dist", "loadfile", *arguments]
    return subprocess.run(command, cwd=ROOT, check=False).returncode


if __name__ == "__main__":
    if len(sys.argv) < 2:
        sys.exit("usage: python .ci/lowest.py FOLDER [PYTEST ARGUMENTS]")
    sys.exit(main(Path(sys.argv[1]), sys.argv[2:]))
