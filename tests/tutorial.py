"""Runs the commands of docs/tutorial.md and writes what they print into the page: ``python -m tests.tutorial``."""

from __future__ import annotations

import os
import re
import shutil
import signal
import subprocess
import sys
import sysconfig
import tempfile
from pathlib import Path

from tests.patience import PATIENCE
from tests.ports import reserved_port

__all__ = ["PAGE", "compiler", "installed", "rendered", "without_the_page"]

ROOT = Path(__file__).resolve().parents[1]
PAGE = ROOT / "docs" / "tutorial.md"

#: The last section needs the page of the viewer, which `make page` builds.
LAST = "\n## A page for any web host\n"

_PORT = "8000"
_BLOCK = re.compile(r"```console\n(.*?)```", re.DOTALL)
_PROGRAM = re.compile(r"```python\n# (\S+\.py)\n(.*?)```", re.DOTALL)
_MARK = "-- command"
#: What differs from run to run.
_VARIES = ((re.compile(r"(/surfaces/|#s=)[0-9a-f]{20}"), r"\1ID"), (re.compile(r"in [0-9.]+ m?s\b"), "in T s"))


def compiler() -> bool:
    """Whether a wheel can be built: there is a C compiler."""
    return any(map(shutil.which, (os.environ.get("CC", "cc").split()[0], "gcc", "clang")))


def installed(folder: Path) -> dict[str, str]:
    """Build the wheel, install it into an empty environment, and return the environment variables of a shell there.

    The libraries that it needs are those of this environment: they are found after those of the new one.
    """
    pip = [sys.executable, "-m", "pip", "--quiet", "--disable-pip-version-check"]
    _run([*pip, "wheel", "--no-deps", "--no-build-isolation", "--wheel-dir", str(folder), str(ROOT)])
    environment = folder / "env"
    _run([sys.executable, "-m", "venv", "--without-pip", str(environment)])
    (wheel,) = folder.glob("*.whl")
    _run([*pip, "--python", str(environment / "bin" / "python"), "install", "--no-deps", "--no-index", str(wheel)])
    (packages,) = environment.glob("lib/python*/site-packages")
    (packages / "libraries.pth").write_text(sysconfig.get_path("purelib") + "\n")
    kept = "LODESTREAM_UNCONFINED"  # see `tests.conftest`
    variables = {
        name: value
        for name, value in os.environ.items()
        if name == kept or not name.startswith(("PYTHON", "LODESTREAM"))
    }
    return {
        **variables,
        "PATH": os.pathsep.join([str(environment / "bin"), os.environ["PATH"]]),
        "LODESTREAM_CACHE": str(folder / "cache"),
        "COLUMNS": "100",
    }


def without_the_page(page: str) -> str:
    """Return the tutorial without its last section."""
    text, heading, _ = page.partition(LAST)
    if not heading:
        raise ValueError(f"expected a section {LAST.strip()!r} in {PAGE.name}")
    return text


def rendered(page: str, folder: Path, variables: dict[str, str]) -> str:
    """Run the commands of a page one after another and return the page with what they print.

    Output that differs only in times and identifiers stays as it was.

    Parameters
    ----------
    page : str
        Markdown. Lines ``$ COMMAND`` of its blocks ``console`` are run by bash; blocks ``python`` that begin with a
        comment ``# NAME.py`` are saved under that name. A command that ends with ``&`` is a server on port 8000.
    folder : Path
        Where they run.
    variables : mapping of str to str
        Their environment.

    Raises
    ------
    AssertionError
        If a command fails.
    """
    commands = [line[2:] for block in _BLOCK.findall(page) for line in block.splitlines() if line.startswith("$ ")]
    with reserved_port() as number:
        port = str(number)
        for name, program in _PROGRAM.findall(page):
            (folder / name).write_text(program.replace(_PORT, port))
        run = [command.replace(_PORT, port) for command in commands]
        outputs = [_as_shown(text, port) for text in _outputs(run, folder, variables)]
    assert len(outputs) == len(commands), f"{commands[len(outputs) - 1]} failed:\n{outputs[-1]}"
    answers = iter(outputs)

    def written(block: re.Match[str]) -> str:
        lines: list[str] = []
        for part in re.split(r"(?m)^(?=\$ )", block[1])[1:]:
            command, _, shown = part.partition("\n")
            printed = next(answers)
            lines += [f"{command}\n", shown if _comparable(shown) == _comparable(printed) else printed]
        return f"```console\n{''.join(lines)}```"

    return _BLOCK.sub(written, page)


def _outputs(commands: list[str], folder: Path, variables: dict[str, str]) -> list[str]:
    """Run commands in one shell, up to the first that fails; return what each prints on both outputs."""
    lines = ["set -e -o pipefail", "trap 'kill $(jobs -p) 2> /dev/null' EXIT"]
    for command in commands:
        lines.append(f"echo '{_MARK}'")
        if command.endswith("&"):
            port = re.findall(r"--port (\d+)", command)[0]
            lines.append(f"{command[:-1]} > server.log 2>&1 &")
            lines.append(f"until (: < /dev/tcp/127.0.0.1/{port}) 2> /dev/null; do")
            lines.append("  kill -0 $! || { cat server.log; exit 1; }; sleep 0.1")
            lines.append("done")
        else:
            lines.append(command)
    lines.append(f"echo '{_MARK}'")  # missing where a command has failed
    process = subprocess.Popen(
        ["bash", "-c", "\n".join(lines)],
        cwd=folder,
        env=variables,
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        start_new_session=True,
    )
    try:
        output, _ = process.communicate(timeout=PATIENCE)
    finally:
        if process.poll() is None:  # it hangs
            os.killpg(process.pid, signal.SIGKILL)
            process.wait()
    parts = output.split(f"{_MARK}\n")[1:]
    return parts[:-1] if len(parts) > len(commands) else parts


def _run(command: list[str]) -> None:
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, f"{' '.join(command)} ended with {done.returncode}:\n{done.stdout}{done.stderr}"


def _as_shown(output: str, port: str) -> str:
    """Put what a command prints as the page has it: on port 8000, without blanks at the ends of lines."""
    return "".join(f"{line.rstrip()}\n" for line in output.replace(port, _PORT).splitlines())


def _comparable(output: str) -> str:
    for varies, word in _VARIES:
        output = varies.sub(word, output)
    return output


def main() -> None:
    """Write the output of all commands into the page."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        variables = installed(folder)
        (folder / "here").mkdir()
        PAGE.write_text(rendered(PAGE.read_text(), folder / "here", variables))


if __name__ == "__main__":
    main()
