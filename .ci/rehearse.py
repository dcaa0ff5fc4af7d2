"""Rehearse a release: build everything into a folder, and try what was built in empty environments.

``python .ci/rehearse.py FOLDER`` makes wheels and source distribution (``wheels.py``) and the npm package, lets twine
look at what PyPI would get, and installs the wheel of this machine with the oldest and the newest Python that are on
PATH. There the demo is run from the wheel. mypy checks library and clients as if this were macOS and Windows, which
takes too long for ``make lint``. Nothing is published.
"""

from __future__ import annotations

import platform
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
#: Minor versions of Python 3 that are looked for, see ``requires-python``.
VERSIONS = range(11, 20)
#: As `sys.platform` says there.
OTHER_SYSTEMS = ("darwin", "win32")


def pythons() -> list[str]:
    """Return the oldest and the newest Python that runs, or the only one."""
    names = [f"python3.{minor}" for minor in VERSIONS]
    there = [name for name in names if shutil.which(name) and runs(name)] or [sys.executable]
    return [there[0], *there[-1:]] if len(there) > 1 else there


def runs(python: str) -> bool:
    """Return whether a command is a Python that makes environments: that of a version manager may only say no."""
    return subprocess.run([python, "-c", "import ensurepip, venv"], capture_output=True, check=False).returncode == 0


def step(title: str, *command: str, folder: Path = ROOT) -> None:
    """Run a step of the release; where it fails, the rehearsal ends."""
    print(f"== {title}: {' '.join(command)}", flush=True)
    code = subprocess.run(command, cwd=folder, check=False).returncode
    if code:
        sys.exit(f"{title} ended with {code}")


def try_wheel(wheel: Path, python: str) -> None:
    """Install a wheel with the server into an empty environment, and run the demo there."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        step(f"an empty environment of {python}", python, "-m", "venv", "env", folder=folder)
        inside = folder / "env" / "bin"
        step("install the wheel", f"{inside}/pip", "install", "--quiet", f"{wheel}[server,plot]", folder=folder)
        step("the demo from the wheel", f"{inside}/lodestream", "demo", folder=folder)


def main(folder: Path) -> None:
    """Build, look, install, run."""
    for system in OTHER_SYSTEMS:
        cache = f"--cache-dir=build/mypy-{system}"
        step(f"types on {system}", sys.executable, "-m", "mypy", f"--platform={system}", cache, "core", "client")
    step("wheels and source distribution", sys.executable, ".ci/wheels.py", str(folder))
    packages = [str(path) for path in sorted(folder.glob("*.whl")) + sorted(folder.glob("*.tar.gz"))]
    step("what PyPI would say", sys.executable, "-m", "twine", "check", "--strict", *packages)
    step("npm package", "npm", "pack", "--silent", "--pack-destination", str(folder), folder=ROOT / "client/web")
    (wheel,) = folder.glob(f"*manylinux*{platform.machine()}*.whl")
    for python in pythons():
        try_wheel(wheel, python)
    for path in sorted(folder.iterdir()):
        print(f"{path.stat().st_size:>9,} {path.name}")


if __name__ == "__main__":
    if len(sys.argv) != 2:
        sys.exit("usage: python .ci/rehearse.py FOLDER")
    main(Path(sys.argv[1]).resolve())
