"""The command as a program of its own: what it loads, prints, and how it ends."""

from __future__ import annotations

import json
import os
import re
import shutil
import signal
import subprocess
import sys
import threading
from collections.abc import Sequence
from pathlib import Path

import pytest
from websockets.sync.server import ServerConnection

import lodestream
import lodestream_client
from lodestream.errors import UnavailableError
from lodestream_client.commands import completion
from lodestream_client.program import build_parser
from tests.patience import PATIENCE

from .. import manual
from ..scripted import document, scripted
from ..stream.test_misbehaving import websocket_server

ROOT = Path(__file__).parents[3]
COMMAND = [sys.executable, "-m", "lodestream_client"]


def environment() -> dict[str, str]:
    paths = [str(ROOT / name) for name in ("core", "server", "client")]
    # What counts lines would load modules before the program does, and print at an interrupt.
    own = {key: value for key, value in os.environ.items() if not key.startswith("COVERAGE_")}
    return {**own, "PYTHONPATH": os.pathsep.join(paths), "COLUMNS": "100"}


def call(*arguments: object, data: bytes = b"") -> subprocess.CompletedProcess[bytes]:
    command = [*COMMAND, *map(str, arguments)]
    return subprocess.run(command, input=data, capture_output=True, env=environment(), timeout=PATIENCE, check=False)


def loaded_after(statement: str, names: Sequence[str]) -> list[str]:
    code = f"{statement}\nimport sys\nprint([name for name in {list(names)!r} if name in sys.modules])"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, env=environment(), check=True)
    return [str(name) for name in json.loads(done.stdout.replace(b"'", b'"'))]


HEAVY = ("fastapi", "uvicorn", "rasterio", "matplotlib")


def test_importing_the_client_is_light() -> None:
    statements = (
        "import lodestream_client",
        "from lodestream_client import Client, AsyncClient, Stream, AsyncStream, SilenceError",
    )
    assert loaded_after("\n".join(statements), HEAVY) == []


def test_the_command_line_is_lighter_still() -> None:
    statement = "from lodestream_client.program import build_parser\nbuild_parser(['--help'])"
    assert loaded_after(statement, (*HEAVY, "numpy", "httpx", "websockets", "rich", "asyncio")) == []


def test_a_command_on_files_loads_no_more_than_it_uses(container_file: Path, tmp_path: Path) -> None:
    npy, again = tmp_path / "out.npy", tmp_path / "again.lode"
    unused = ("fastapi", "rasterio", "httpx", "websockets", "rich", "asyncio", "urllib.request", "lodestream_server")
    for words in (["decode", str(container_file), str(npy)], ["encode", str(npy), str(again)]):
        statement = f"from lodestream_client.__main__ import main\nassert main({words}) == 0"
        assert loaded_after(statement, unused) == []
    statement = "from lodestream_client.program import build_parser\nbuild_parser(['decode', 'a', 'b'])"
    assert loaded_after(statement, (*unused, "importlib.metadata")) == []


def test_what_only_asks_a_server_loads_nothing_that_decodes() -> None:
    with scripted(lambda asked: document({"surfaces": []})) as server:
        statement = f"from lodestream_client.__main__ import main\nassert main(['list', {server.url!r}]) == 0"
        unused = (*HEAVY, "numpy", "websockets", "lodestream.container", "lodestream_client.stream.session")
        assert loaded_after(statement, unused) == []


def test_all_names_are_there() -> None:
    for name in lodestream_client.__all__:
        assert getattr(lodestream_client, name) is not None
    assert list(lodestream_client.__all__) == sorted(lodestream_client.__all__, key=lambda name: (name.islower(), name))
    with pytest.raises(AttributeError, match="no attribute 'juggle'"):
        _ = lodestream_client.juggle


def test_version_and_help() -> None:
    assert call("--version").stdout.decode() == f"lodestream {lodestream.__version__}\n"
    done = call("--help")
    assert done.returncode == 0
    commands = re.findall(r"^  ([a-z]+)\b", done.stdout.decode(), re.MULTILINE)
    assert set(commands) == set(manual.COMMANDS)


def test_the_manual_is_the_help(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COLUMNS", "100")
    # How lines are broken differs from one version of argparse to the next.
    assert manual.PATH.read_text().split() == manual.render().split(), "run python -m tests.client.manual"


def _completions(line: str, folder: Path) -> list[str]:
    """What a shell is told at the end of a line."""
    asked = {"_ARGCOMPLETE": "1", "COMP_LINE": line, "COMP_POINT": str(len(line)), "COMP_TYPE": "9"}
    asked |= {"_ARGCOMPLETE_STDOUT_FILENAME": str(folder / "told"), "_ARGCOMPLETE_IFS": "\n"}
    done = subprocess.run(COMMAND, env={**environment(), **asked}, capture_output=True, timeout=PATIENCE, check=False)
    assert done.returncode == 0, done.stderr
    return (folder / "told").read_text().split("\n")


@pytest.mark.long
def test_shells_complete_commands_and_options(tmp_path: Path) -> None:
    pytest.importorskip("argcomplete")
    assert {"encode", "decode"} <= {word.strip() for word in _completions("lodestream ", tmp_path)}
    assert [word.strip() for word in _completions("lodestream conv", tmp_path)] == ["convert"]
    assert [word.strip() for word in _completions("lodestream encode --prec", tmp_path)] == ["--precision"]
    assert [word.strip() for word in _completions("lodestream encode --closed r", tmp_path)] == ["rows"]
    assert "serve" in [word.strip() for word in _completions("lodestream s", tmp_path)]
    for shell in ("bash", "zsh", "fish"):
        printed = call("completion", shell)
        assert printed.returncode == 0
        assert b"lodestream" in printed.stdout
        assert b"\\n#" not in printed.stdout
        assert printed.stdout.startswith(b"#compdef lodestream\n") == (shell == "zsh")


@pytest.mark.skipif(shutil.which("bash") is None, reason="needs bash")
def test_bash_knows_the_command_by_what_is_printed_for_it() -> None:
    pytest.importorskip("argcomplete")
    script = call("completion", "bash").stdout
    asked = b'eval "$(cat)"; complete -p lodestream; type _python_argcomplete'
    done = subprocess.run(["bash", "-c", asked], input=script, capture_output=True, timeout=PATIENCE, check=False)
    assert done.returncode == 0, done.stderr
    assert b"-F _python_argcomplete lodestream" in done.stdout


def test_completion_without_its_library_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "argcomplete", None)
    with pytest.raises(UnavailableError, match=r"pip install 'lodestream\[completion\]'"):
        completion.complete(build_parser())


@pytest.mark.long
def test_the_package_runs_as_a_module() -> None:
    command = [sys.executable, "-m", "lodestream"]
    for arguments in (["--version"], ["formats", "--json"], ["nonsense"]):
        ours = subprocess.run(
            [*command, *arguments], capture_output=True, env=environment(), timeout=PATIENCE, check=False
        )
        assert ours.returncode == call(*arguments).returncode
        assert ours.stdout == call(*arguments).stdout
        assert ours.stderr == call(*arguments).stderr


def test_the_module_says_where_its_program_is_not_installed() -> None:
    code = "import importlib.metadata as m; m.entry_points = lambda **_: (); import lodestream.__main__ as main; "
    done = subprocess.run(
        [sys.executable, "-c", f"{code}raise SystemExit(main.main())"],
        capture_output=True,
        text=True,
        env=environment(),
        timeout=PATIENCE,
        check=False,
    )
    assert (done.returncode, done.stdout) == (1, "")
    assert done.stderr == "lodestream: the command is not installed: pip install lodestream\n"


def test_pipes(terrain_file: Path) -> None:
    encoded = call("encode", "-", "-", data=terrain_file.read_bytes())
    assert encoded.returncode == 0
    whole = call("decode", "-", "-", data=encoded.stdout)
    assert whole.stdout == terrain_file.read_bytes()
    assert b"complete" in whole.stderr
    described = call("info", "-", "--json", data=encoded.stdout)
    assert json.loads(described.stdout)["shape"] == [97, 70]


@pytest.mark.parametrize("arguments", [("info",), ("decode", "-")])
def test_a_closed_pipe_is_quiet(container_file: Path, arguments: tuple[str, ...]) -> None:
    read, write = os.pipe()
    os.close(read)
    command = [*COMMAND, arguments[0], str(container_file), *arguments[1:]]
    done = subprocess.run(
        command, stdout=write, stderr=subprocess.PIPE, env=environment(), timeout=PATIENCE, check=False
    )
    os.close(write)
    assert done.returncode == 1
    assert done.stderr == b""


INTERRUPTING = """\
import os, signal, sys
class Finder:
    def find_spec(self, name, path=None, target=None):
        if name == {name!r}:
            os.kill(os.getpid(), signal.SIGINT)
            os.write(1, b"went on\\n" if {ignored!r} else b"")
sys.meta_path.insert(0, Finder())
from lodestream_client.__main__ import main
sys.exit(main(["--help"]))
"""

#: What is loaded before a command begins: the first of it, what the parsers need, and the server's part.
LOADED = (
    "lodestream_client.program",
    "argparse",
    "lodestream",
    "lodestream_client.commands",
    "lodestream_server.commands.serve",
)


@pytest.mark.usefixtures("interrupts")
@pytest.mark.parametrize("name", LOADED)
def test_an_interrupt_while_a_command_is_loaded_is_silent(name: str) -> None:
    code = INTERRUPTING.format(name=name, ignored=False)
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, env=environment(), check=False)
    assert (done.returncode, done.stdout, done.stderr) == (130, b"", b"")


def test_an_interrupt_that_is_ignored_stays_so() -> None:
    code = "import signal; signal.signal(signal.SIGINT, signal.SIG_IGN)\n" + INTERRUPTING.format(
        name="lodestream_client.program", ignored=True
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, env=environment(), check=False)
    assert (done.returncode, done.stderr) == (0, b"")
    assert done.stdout.startswith(b"went on\n")


@pytest.mark.usefixtures("interrupts")
def test_nothing_is_loaded_before_interrupts_are_seen_to() -> None:
    statement = "import lodestream_client.__main__"
    assert loaded_after(statement, ("argparse", "contextlib", "enum", "typing", "lodestream", "numpy", "pathlib")) == []


@pytest.mark.usefixtures("interrupts")
def test_an_interrupt_ends_with_one_line(tmp_path: Path) -> None:
    heard = threading.Event()

    def behave(connection: ServerConnection) -> None:
        heard.set()
        for _ in connection:
            pass

    with websocket_server(behave) as url:
        process = subprocess.Popen(
            [*COMMAND, "pull", url, str(tmp_path / "out.npy")], stderr=subprocess.PIPE, env=environment()
        )
        assert heard.wait(PATIENCE)
        process.send_signal(signal.SIGINT)
        _, said = process.communicate(timeout=PATIENCE)
    out = tmp_path / "out.npy"
    assert (process.returncode, said.decode()) == (130, f"lodestream: interrupted: {out} is not written\n")
    assert list(tmp_path.iterdir()) == []


def test_no_colours_and_no_bars_where_there_is_no_terminal(container_file: Path, tmp_path: Path) -> None:
    done = call("decode", container_file, tmp_path / "out.obj")
    assert b"\x1b" not in done.stdout + done.stderr
    assert done.stdout == b""
    assert done.stderr.count(b"\n") == 1
