"""Emulators of buckets for tests: ministack for S3, Azurite for Azure. Each is started once in a process of pytest.

They are installed when they are first needed, into build/emulators, from ``ministack.txt`` and ``azurite/``. What is
missing skips the tests, and is a failure where CI is set in the environment (`.ci/run`).

The fixtures to use are `s3` and `azure`: each sets the environment for one test, and makes addresses.
"""

from __future__ import annotations

import base64
import hashlib
import hmac
import http.client
import os
import secrets
import shutil
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from email.utils import formatdate
from pathlib import Path

import pytest

from lodestream.operating_system import lock, open_own
from tests.patience import PATIENCE
from tests.ports import reserved_port

__all__ = ["Emulator", "azure", "azurite", "ministack", "reach", "running_ministack", "s3"]

HERE = Path(__file__).parent
INSTALLED = HERE.parents[1] / "build" / "emulators"

#: The bucket and the container that are there from the beginning.
BUCKET = "tests"
ACCOUNT = "lodestreamtests"


@dataclass(frozen=True)
class Emulator:
    """A service that runs on this machine.

    Attributes
    ----------
    port : int
    scheme : str
        Of the addresses of its stores.
    environment : dict
        What a program that uses it has in its environment.
    endpoint : str
        The name of the variable of the environment that says where it is.
    """

    port: int
    scheme: str
    endpoint: str
    environment: dict[str, str] = field(repr=False)

    def at(self, port: int) -> dict[str, str]:
        """Return the environment of a program that reaches it through another port."""
        path = f"/{ACCOUNT}" if self.scheme == "az" else ""
        return self.environment | {self.endpoint: f"http://127.0.0.1:{port}{path}"}

    def address(self) -> str:
        """Return the address of a new, empty store."""
        return f"{self.scheme}://{BUCKET}/{secrets.token_hex(8)}/store"


def _missing(what: str) -> None:
    if os.environ.get("CI"):
        pytest.fail(what)
    pytest.skip(what)


def _installed(name: str, declared: list[Path], install: Callable[[Path], None]) -> Path:
    """Return the folder of an emulator, where it is installed unless what is declared is there already."""
    if sys.platform == "win32":
        pytest.skip("the emulators are started on Linux and macOS")
    digest = hashlib.sha256(b"".join(path.read_bytes() for path in declared)).hexdigest()
    folder = INSTALLED / name
    folder.mkdir(parents=True, exist_ok=True)
    handle = open_own(INSTALLED / f"{name}.lock", create=True)
    try:
        lock(handle, wait=True)  # other processes of pytest need it too
        stamp = folder / ".installed"
        if not stamp.exists() or stamp.read_text() != digest:
            shutil.rmtree(folder)
            folder.mkdir()
            try:
                install(folder)
            except subprocess.CalledProcessError as error:
                _missing(f"{name} cannot be installed: {error.stderr.strip()[-500:]}")
            stamp.write_text(digest)
    finally:
        os.close(handle)
    return folder


def _run(*command: str | Path, folder: Path) -> None:
    subprocess.run(command, cwd=folder, check=True, capture_output=True, text=True, timeout=PATIENCE)


def _install_ministack(folder: Path) -> None:
    _run(sys.executable, "-m", "venv", folder, folder=folder)
    # By itself: what PYTHONPATH leads to now is not there when it runs.
    pip: list[str | Path] = [folder / "bin" / "python", "-I", "-m", "pip", "--disable-pip-version-check"]
    _run(*pip, "install", "--quiet", "--requirement", HERE / "ministack.txt", folder=folder)


def _install_azurite(folder: Path) -> None:
    for name in ("package.json", "package-lock.json", ".npmrc"):
        shutil.copy(HERE / "azurite" / name, folder)
    # Not `npm ci`: see the Makefile.
    _run("npm", "install", "--no-save", "--silent", "--no-audit", "--no-fund", folder=folder)


@contextmanager
def _running(command: list[str | Path], environment: dict[str, str], folder: Path, port: int) -> Iterator[None]:
    """Run a program until the block ends; it begins when the program listens on a port of this machine."""
    with (folder / "output").open("wb") as output:
        process = subprocess.Popen(command, env=environment, cwd=folder, stdout=output, stderr=output)
    try:
        end = time.monotonic() + PATIENCE
        while True:
            with socket.socket() as probe:
                if probe.connect_ex(("127.0.0.1", port)) == 0:
                    break
            if process.poll() is not None or time.monotonic() > end:
                pytest.fail(f"{command} does not start: {(folder / 'output').read_text()[-2000:]}")
            time.sleep(0.05)
        yield
    finally:
        process.terminate()
        try:
            process.wait(10)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()


def _make(port: int, path: str, headers: dict[str, str]) -> None:
    """Make a bucket or a container."""
    connection = http.client.HTTPConnection("127.0.0.1", port, timeout=PATIENCE)
    connection.request("PUT", path, headers={"Content-Length": "0", **headers})
    assert connection.getresponse().status in (200, 201)
    connection.close()


@pytest.fixture(scope="session")
def ministack(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Emulator]:
    """S3 on this machine."""
    with running_ministack(tmp_path_factory.mktemp("ministack")) as emulator:
        yield emulator


@contextmanager
def running_ministack(work: Path) -> Iterator[Emulator]:
    """Run S3 on this machine, with a bucket, for the length of a block; it writes into a folder."""
    folder = _installed("ministack", [HERE / "ministack.txt"], _install_ministack)
    own = {
        "PATH": os.environ["PATH"],
        "HOME": str(work),
        "TMPDIR": str(work),
        "BIND_HOST": "127.0.0.1",
        "SERVICES": "s3",
        "IOT_MTLS_ENABLED": "0",
    }
    environment = {
        "AWS_ACCESS_KEY_ID": "AKIA" + secrets.token_hex(8).upper(),
        "AWS_SECRET_ACCESS_KEY": secrets.token_hex(20),
        "AWS_REGION": "us-east-1",
    }
    command: list[str | Path] = [folder / "bin" / "python", "-m", "ministack"]
    with reserved_port() as port, _running(command, own | {"GATEWAY_PORT": str(port)}, work, port):
        _make(port, f"/{BUCKET}", {})
        reached = environment | {"AWS_ENDPOINT_URL": f"http://127.0.0.1:{port}"}
        yield Emulator(port, "s3", "AWS_ENDPOINT_URL", reached)


@pytest.fixture(scope="session")
def azurite(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Emulator]:
    """Azure Blob Storage on this machine."""
    node = shutil.which("node")
    if node is None or shutil.which("npm") is None:
        _missing("Azurite needs Node 20 and npm")
    folder = _installed("azurite", sorted((HERE / "azurite").glob("package*.json")), _install_azurite)
    work = tmp_path_factory.mktemp("azurite")
    key = base64.b64encode(secrets.token_bytes(64)).decode()
    program = folder / "node_modules" / ".bin" / "azurite-blob"
    command: list[str | Path] = [str(node), program, "--silent", "--disableTelemetry"]
    command += ["--inMemoryPersistence", "--blobHost", "127.0.0.1", "--blobPort"]
    own = {"PATH": os.environ["PATH"], "HOME": str(work), "AZURITE_ACCOUNTS": f"{ACCOUNT}:{key}"}
    environment = {
        "AZURE_STORAGE_ACCOUNT_NAME": ACCOUNT,
        "AZURE_STORAGE_ACCOUNT_KEY": key,
    }
    with reserved_port() as port, _running([*command, str(port)], own, work, port):
        date, version = formatdate(usegmt=True), "2021-08-06"
        signed = f"PUT{chr(10) * 12}x-ms-date:{date}\nx-ms-version:{version}\n"
        signed += f"/{ACCOUNT}/{ACCOUNT}/{BUCKET}\nrestype:container"
        mac = hmac.new(base64.b64decode(key), signed.encode(), hashlib.sha256).digest()
        signature = f"SharedKey {ACCOUNT}:{base64.b64encode(mac).decode()}"
        own_headers = {"x-ms-date": date, "x-ms-version": version, "Authorization": signature}
        _make(port, f"/{ACCOUNT}/{BUCKET}?restype=container", own_headers)
        reached = environment | {"AZURE_STORAGE_ENDPOINT": f"http://127.0.0.1:{port}/{ACCOUNT}"}
        yield Emulator(port, "az", "AZURE_STORAGE_ENDPOINT", reached)


def reach(environment: dict[str, str], patch: pytest.MonkeyPatch) -> None:
    """Let the environment lead to an emulator, and to no other store."""
    for name in os.environ:
        if name.startswith(("AWS_", "AZURE_")):
            patch.delenv(name)
    for name, value in {**environment, "NO_PROXY": "127.0.0.1"}.items():
        patch.setenv(name, value)


@pytest.fixture
def s3(ministack: Emulator, monkeypatch: pytest.MonkeyPatch) -> Emulator:
    """S3, to which the environment of this test and of the programs that it starts leads."""
    reach(ministack.environment, monkeypatch)
    return ministack


@pytest.fixture
def azure(azurite: Emulator, monkeypatch: pytest.MonkeyPatch) -> Emulator:
    """Azure Blob Storage, to which the environment of this test and of the programs that it starts leads."""
    reach(azurite.environment, monkeypatch)
    return azurite
