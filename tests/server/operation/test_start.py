"""A server that cannot start says why in one line and exits with 1; what it makes on the disk is its owner's alone."""

from __future__ import annotations

import errno
import json
import os
import re
import shutil
import socket
import stat
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator
from contextlib import closing
from pathlib import Path
from typing import BinaryIO

import httpx
import pytest

from lodestream.confinement import landlock, seccomp
from lodestream.errors import LodestreamError
from lodestream_client.__main__ import main
from lodestream_server import Settings, create_app, running_server
from lodestream_server.access.tokens import TokenFile
from lodestream_server.commands.serve import warn_of_unknown_variables
from lodestream_server.store import durable
from lodestream_server.store.data import Data
from lodestream_server.store.durable import Disk
from tests.server.helpers import PATIENCE, Keys, hills, npy, problem, push

Refused = Callable[..., str]

#: Variables that would change what is refused. That of `tests.conftest` stays.
SETTINGS = {name for name in os.environ if name.startswith("LODESTREAM_")} - {"LODESTREAM_UNCONFINED"}


def lodestream(*arguments: object) -> subprocess.CompletedProcess[str]:
    environment = {name: value for name, value in os.environ.items() if name not in SETTINGS}
    environment["PYTHONPATH"] = os.pathsep.join(filter(None, sys.path))
    command = [sys.executable, "-m", "lodestream_client", *map(str, arguments)]
    return subprocess.run(command, env=environment, capture_output=True, text=True, timeout=PATIENCE)


def refused_program(*arguments: object) -> str:
    """The one line with which a process of the command ends."""
    done = lodestream(*arguments)
    return the_line(done.returncode, done.stdout, done.stderr)


def the_line(code: int, out: str, err: str) -> str:
    assert (code, out) == (1, ""), err
    assert err.startswith("lodestream: ")
    assert err.count("\n") == 1
    return err.removesuffix("\n")


@pytest.fixture
def refused(called_here: None, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Refused:
    """The same within this process."""
    for name in SETTINGS:
        monkeypatch.delenv(name)

    def call(*arguments: object) -> str:
        capsys.readouterr()
        code = main([str(argument) for argument in arguments])
        return the_line(code, *capsys.readouterr())

    return call


@pytest.fixture
def closed(tmp_path: Path) -> Iterator[Path]:
    """A folder in which nothing can be made, not even by root."""
    folder = tmp_path / "closed"
    folder.mkdir(0o500)
    if not os.access(folder, os.W_OK):
        yield folder
        return
    kernel = Path("/sys/kernel")
    if not kernel.is_dir():
        pytest.skip("no folder refuses root here")
    yield kernel


def test_a_folder_that_another_server_uses(tmp_path: Path) -> None:
    with running_server(tmp_path):
        line = refused_program("serve", "--port", "0", "--data", tmp_path)
    assert str(tmp_path) in line
    assert "another" in line


def test_a_folder_that_cannot_be_written(closed: Path, refused: Refused) -> None:
    assert f"{closed}/lock: " in refused("serve", "--port", "0", "--data", closed)
    assert f"{closed}/data: " in refused("serve", "--port", "0", "--data", closed / "data")
    assert f"{closed}/tokens.json" in refused("token", "create", "--data", closed)
    assert f"{closed}/data: " in refused("token", "create", "--data", closed / "data")


def test_a_scratch_folder_that_cannot_be_used_is_told_with_its_option(tmp_path: Path, closed: Path) -> None:
    (tmp_path / "file").write_text("")
    data, scratch = tmp_path / "data", tmp_path / "scratch"
    with closing(Data(data, scratch)):
        for place, words in (
            (tmp_path / "file", "Not a directory"),
            (closed / "none", "(No such file or directory|Permission denied|Read-only|Operation not permitted)"),
            (scratch, "which another one uses"),
        ):
            with pytest.raises(LodestreamError, match=rf"{words}: each server needs .* of its own \(--scratch\)$"):
                Data(tmp_path / f"{place.name}-data", place)


@pytest.mark.parametrize("name", ["", ".lodestream", "surfaces", "built", "uploads", "containers", "names", "scratch"])
def test_a_folder_that_can_be_read_but_not_written_any_more(
    tmp_path: Path, name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    data = tmp_path / "data"
    Data(data).close()
    folder = data / name
    folder.mkdir(exist_ok=True)
    folder.chmod(0o500)
    if os.access(folder, os.W_OK):  # root: what the system says of a disk that is mounted for reading
        ask = os.access
        monkeypatch.setattr(os, "access", lambda path, mode: path != folder and ask(path, mode))
    with pytest.raises((LodestreamError, PermissionError), match=re.escape(str(folder))), running_server(data):
        pass
    folder.chmod(0o700)
    monkeypatch.undo()
    Data(data).close()


def test_a_data_folder_of_an_earlier_version_is_refused_and_left_alone(tmp_path: Path, refused: Refused) -> None:
    (tmp_path / "records").mkdir()
    (tmp_path / "records" / "0.json").write_text("{}")
    (tmp_path / "work" / "0").mkdir(parents=True)
    line = refused("serve", "--port", "0", "--data", tmp_path)
    assert "an earlier one: start with a new folder, and push the containers" in line
    assert f"{tmp_path}/containers/*.lode" in line
    assert sorted(path.name for path in tmp_path.rglob("*")) == ["0", "0.json", "lock", "records", "work"]


@pytest.mark.parametrize("other_disk", [False, True])
def test_what_can_be_made_again_may_be_elsewhere(tmp_path: Path, other_disk: bool) -> None:
    data, shm = tmp_path / "data", Path("/dev/shm")
    if other_disk and (not shm.is_dir() or shm.stat().st_dev == tmp_path.stat().st_dev):
        pytest.skip("there is no other disk")
    with tempfile.TemporaryDirectory(dir=shm if other_disk else tmp_path) as folder:
        scratch = Path(folder) / "above" / "scratch"

        def client(url: str) -> httpx.Client:
            return httpx.Client(base_url=url, trust_env=False, timeout=PATIENCE)

        with running_server(data, scratch=scratch, workers=1) as url, client(url) as http:
            made = push(http, npy(hills(12, 9)))
            level = http.get(f"{made['url']}/levels/0", params={"format": "npy"})
            assert (made["state"], level.status_code) == ("ready", 200)
            assert mode(scratch / "lodestream") == 0o700
            assert {path.name for path in (scratch / "lodestream").iterdir()} >= {"index.sqlite", "work", "levels"}
        places = {".lodestream", "built", "containers", "lock", "lodestream.json", "probe", "surfaces", "uploads"}
        assert {path.name for path in data.iterdir()} == places
        # Nothing of it is needed by the next server.
        shutil.rmtree(scratch)
        with running_server(data, scratch=scratch, workers=1) as url, client(url) as http:
            assert http.get(made["url"]).json() == made
        with running_server(data, workers=1) as url, client(url) as http:
            assert http.get(made["url"]).json() == made


def test_the_command_that_makes_the_first_token_is_told_whole(tmp_path: Path, refused: Refused) -> None:
    data, file = tmp_path / "the data", tmp_path / "tokens"
    told = "create one with `lodestream token create NAME --scope write"
    assert f"{told} --data '{data}'`" in refused("serve", "--host", "0.0.0.0", "--data", data)
    line = refused("serve", "--origins", "*", "--data", data, "--token-file", file)
    assert f"{told} --token-file {file}`" in line


def test_a_variable_that_is_nearly_a_setting_is_told(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    for name in ("LODESTREAM_PUBLICREADS", "LODESTREAM_TOKEN", "LODESTREAM_SERVICE_PORT", "LODESTREAM_PORT"):
        monkeypatch.setenv(name, "yes")
    warn_of_unknown_variables()
    assert caplog.messages == ["there is no setting LODESTREAM_PUBLICREADS; is LODESTREAM_PUBLIC_READS meant?"]


def test_a_file_in_the_place_of_a_folder(tmp_path: Path, refused: Refused) -> None:
    file = tmp_path / "data"
    file.write_text("not a folder")
    for folder in (file, file / "below"):
        assert "Not a directory" in refused("serve", "--port", "0", "--data", folder)
        assert "Not a directory" in refused("token", "create", "--data", folder)
    assert "Not a directory" in refused("serve", "--port", "0", "--data", file, "--token-file", tmp_path / "tokens")
    assert file.read_text() == "not a folder"


@pytest.mark.parametrize("content", [b"", b"[", b"{}", b"\xff\xfe", b"[" * 100_000, b'{"version": 1, "tokens": [7]}'])
def test_a_token_file_that_is_none(tmp_path: Path, refused: Refused, content: bytes) -> None:
    path = tmp_path / "tokens.json"
    path.write_bytes(content)
    for command in (("serve", "--port", "0"), ("token", "create"), ("token", "list"), ("token", "revoke", "x")):
        assert str(path) in refused(*command, "--data", tmp_path)
    assert path.read_bytes() == content


def test_a_token_file_that_cannot_be_read(tmp_path: Path, refused: Refused) -> None:
    path = tmp_path / "tokens.json"
    path.mkdir()
    for command in (("serve", "--port", "0"), ("token", "create"), ("token", "list")):
        assert str(path) in refused(*command, "--data", tmp_path)


@pytest.mark.long
def test_an_address_that_is_taken_or_not_ours(tmp_path: Path, refused: Refused) -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        line = refused_program("serve", "--port", port, "--data", tmp_path)
        assert line == (f"lodestream: cannot listen on 127.0.0.1 port {port}: {os.strerror(98)}")
        # In the same process the folder is free again.
        for _ in range(2):
            with pytest.raises(LodestreamError, match=f"port {port}"), running_server(tmp_path, port=port):
                pass
    for host in ("192.0.2.1", "nowhere.invalid"):
        assert host in refused("serve", "--port", "0", "--host", host, "--insecure", "--data", tmp_path)
    with running_server(tmp_path) as url:
        assert httpx.get(f"{url}/healthz", trust_env=False, timeout=PATIENCE).status_code == 200


def test_a_name_with_several_addresses_is_served_at_each(tmp_path: Path) -> None:
    found = {info[4][0] for info in socket.getaddrinfo("localhost", 0, type=socket.SOCK_STREAM)}
    with running_server(tmp_path, host="localhost") as url:
        assert httpx.get(f"{url}/healthz", trust_env=False, timeout=PATIENCE).status_code == 200
        assert url.rsplit(":", 1)[0].removeprefix("http://").strip("[]") in found


@pytest.mark.parametrize("origin", ["*", "null"])
def test_pages_of_all_sites_need_a_token_to_be_there(tmp_path: Path, keys: Keys, refused: Refused, origin: str) -> None:
    for options in ((), ("--insecure",), ("--public-reads",)):
        line = refused("serve", "--port", "0", "--data", tmp_path, "--origins", f"https://a.example,{origin}", *options)
        assert f"LODESTREAM_ORIGINS={origin}" in line
        assert str(tmp_path / "tokens.json") in line
    create_app(Settings(data=keys.folder, origins=(origin,)))


def listed(url: str, headers: dict[str, str]) -> httpx.Response:
    return httpx.get(f"{url}/v1/surfaces", headers=headers, trust_env=False, timeout=PATIENCE)


def test_pages_of_all_sites_use_a_server_with_their_token(keys: Keys) -> None:
    with running_server(keys.folder, workers=1, origins=("*",)) as url:
        for site in ("https://a.example", "null", url):
            page = {"origin": site, **keys.header("write")}
            answer = listed(url, page)
            assert answer.status_code == 200
            assert answer.headers["access-control-allow-origin"] == "*"
            assert "access-control-allow-credentials" not in answer.headers
            assert problem(listed(url, {"origin": site}))[0] == 401


def mode(path: Path) -> int:
    return stat.S_IMODE(path.stat().st_mode)


@pytest.fixture
def open_umask() -> Iterator[None]:
    """A process that would let everybody read and write what it makes."""
    before = os.umask(0)
    yield
    os.umask(before)


@pytest.mark.usefixtures("open_umask")
def test_what_a_server_makes_is_its_owners_alone(tmp_path: Path) -> None:
    data = tmp_path / "above" / "data"
    with (
        running_server(data, workers=1) as url,
        httpx.Client(base_url=url, trust_env=False, timeout=PATIENCE) as http,
    ):
        surface = push(http, npy(hills(12, 9)))
        assert surface["state"] == "ready"
        assert http.get(f"{surface['url']}/levels/1").status_code == 200
        levels = [data / "scratch" / "levels", *(data / "scratch" / "levels").iterdir()]
        assert [mode(path) for path in levels] == [0o700, 0o600]
    assert mode(data) == 0o700
    assert mode(data / "lock") == 0o600
    places = [data / folder for folder in ("surfaces", "built", "uploads", "containers")]
    files = [data / "lodestream.json", *places, *(path for place in places for path in place.rglob("*"))]
    assert len(files) == 10
    assert (mode(data / ".lodestream"), mode(data / "scratch")) == (0o700, 0o700)
    scratch = list((data / "scratch").rglob("*"))
    assert {path.name for path in scratch} >= {"index.sqlite", "index.sqlite.room"}
    for path in [*files, *scratch]:
        assert mode(path) == (0o700 if path.is_dir() else 0o600), path


@pytest.mark.usefixtures("open_umask")
def test_a_data_folder_that_is_open_to_others_is_closed(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    data = tmp_path / "data"
    for setup in (0o755, 0o777, 0o2750):
        data.mkdir(exist_ok=True)
        data.chmod(setup)
        Data(data).close()
        assert mode(data) == setup & ~0o077
    assert not [record for record in caplog.records if record.levelname == "WARNING"]
    # With something else in it, it may be somebody's home.
    (data / "thesis.tex").write_text("")
    data.chmod(0o755)
    Data(data).close()
    assert mode(data) == 0o755
    (warning,) = [record for record in caplog.records if record.levelname == "WARNING"]
    assert "thesis.tex" in warning.getMessage()
    assert "chmod 700" in warning.getMessage()


def test_a_data_folder_that_cannot_be_closed_is_warned_of(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    def chmod(path: Path, mode: int) -> None:
        raise PermissionError(1, "Operation not permitted", str(path))

    tmp_path.chmod(0o755)
    monkeypatch.setattr(Path, "chmod", chmod)
    Data(tmp_path).close()
    assert "Operation not permitted" in caplog.text
    assert str(tmp_path) in caplog.text


@pytest.mark.usefixtures("open_umask")
def test_the_token_file_is_its_owners_alone_from_the_first_byte(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    seen: list[int] = []

    class Watched(Disk):
        def write(self, file: BinaryIO, data: bytes) -> None:
            seen.append(stat.S_IMODE(os.fstat(file.fileno()).st_mode))
            super().write(file, data)
            seen.append(stat.S_IMODE(os.fstat(file.fileno()).st_mode))

    monkeypatch.setattr(durable, "disk", Watched())
    path = tmp_path / "keys" / "tokens.json"
    TokenFile(path).create("one", ("read",))
    assert mode(path) == 0o600
    assert mode(path.parent) == 0o700
    path.chmod(0o640)  # whoever did so has a reason, and its successor gets this mode once it is whole
    TokenFile(path).create("two", ("read",))
    assert mode(path) == 0o640
    assert seen == [0o600] * 4


def test_a_token_file_that_cannot_be_replaced_leaves_nothing_behind(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "tokens.json"
    TokenFile(path).create("one", ("read",))
    before = path.read_bytes()

    class Broken(Disk):
        def rename(self, source: Path, target: Path) -> None:
            raise OSError(5, "Input/output error", str(target))

    monkeypatch.setattr(durable, "disk", Broken())
    with pytest.raises(OSError, match="Input/output"):
        TokenFile(path).create("two", ("read",))
    assert path.read_bytes() == before
    assert list(tmp_path.iterdir()) == [path]
    assert [token["name"] for token in json.loads(before)["tokens"]] == ["one"]


def test_a_server_starts_on_a_disk_whose_size_cannot_be_told(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    told = shutil.disk_usage

    def stale(folder: Path) -> object:
        monkeypatch.setattr(shutil, "disk_usage", told)
        raise OSError(errno.ESTALE, "Stale file handle", str(folder))

    monkeypatch.setattr(shutil, "disk_usage", stale)
    with (
        running_server(tmp_path / "data", workers=1) as url,
        httpx.Client(base_url=url, trust_env=False, timeout=PATIENCE) as http,
    ):
        surface = push(http, npy(hills()))
        assert http.get(f"{surface['url']}/levels/0", params={"format": "npy"}).status_code == 200
    assert "the size of the disk is unknown, so that few levels and containers are kept: [Errno 116]" in caplog.text


@pytest.mark.parametrize(
    "lacks",
    [["landlock"], ["seccomp"], ["landlock", "seccomp"]],
    ids=" and ".join,
)
def test_a_kernel_that_does_not_confine_builds(
    lacks: list[str], tmp_path: Path, refused: Refused, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Whatever the kernel says that it has: what counts is whether it holds a process when it comes to it."""
    monkeypatch.delenv("LODESTREAM_UNCONFINED", raising=False)
    for module in (landlock, seccomp):
        name = module.__name__.rpartition(".")[2]
        monkeypatch.setattr(module, "restrict", lambda *_, holds=name not in lacks, **__: holds)
    line = refused("serve", "--port", "0", "--data", tmp_path / "data")
    assert [name for name in ("landlock", "seccomp") if f"{name}: a build may" in line] == lacks
    assert "--unconfined" in line
    assert not (tmp_path / "data").exists()
    # With the word the next thing that is wrong is said.
    (tmp_path / "file").write_bytes(b"")
    assert "Not a directory" in refused("serve", "--port", "0", "--data", tmp_path / "file", "--unconfined")


def test_what_is_available_is_what_a_process_is_confined_by() -> None:
    program = "from lodestream.confinement import *; print(available() == confine(Rights()))"
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, sys.path))}
    assert subprocess.check_output([sys.executable, "-c", program], env=environment, text=True) == "True\n"
