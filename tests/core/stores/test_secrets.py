"""No credential is in an error, a log, what is printed, or a `repr`, whatever goes wrong."""

from __future__ import annotations

import base64
import logging
import os
import threading
import traceback
from collections.abc import Callable, Iterator
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import pytest

from lodestream.errors import LodestreamError
from lodestream.stores import StoreError, Tag
from lodestream.stores.bucket import Bucket
from lodestream.stores.connections import Limits

HASTY = Limits(stalled=1.0, request=2.0, part=2.0, retries=1, again=0.0)

#: What is planted. A signature is in the address of each request, and a key makes a signature in its headers.
SECRET, SESSION, SIGNATURE = "Planted1SecretAccessKey", "Planted2SessionToken", "Planted3SasSignature"
ACCOUNT_KEY = base64.b64encode(b"Planted4AccountKey").decode()
PASSWORD = "Planted5Password"
PLANTED = (SECRET, SESSION, SIGNATURE, ACCOUNT_KEY, PASSWORD, "Planted")

S3 = {
    "AWS_ACCESS_KEY_ID": "AKIAPUBLIC",
    "AWS_SECRET_ACCESS_KEY": SECRET,
    "AWS_SESSION_TOKEN": SESSION,
    "AWS_REGION": "us-east-1",
}
AZURE = {"AZURE_STORAGE_ACCOUNT_NAME": "account"}
SAS = AZURE | {"AZURE_STORAGE_SAS_KEY": f"sv=2022-11-02&sp=rwdl&se=2040-01-01&sig={SIGNATURE}"}
KEY = AZURE | {"AZURE_STORAGE_ACCOUNT_KEY": ACCOUNT_KEY}
#: Addresses, and the environment with which they are opened; ``ENDPOINT`` is where something answers.
STORES = [
    pytest.param("s3://bucket/a", S3 | {"AWS_ENDPOINT_URL": "ENDPOINT"}, id="s3"),
    pytest.param("az://container/a", SAS | {"AZURE_STORAGE_ENDPOINT": "ENDPOINT"}, id="azure, signature"),
    pytest.param("az://container/a", KEY | {"AZURE_STORAGE_ENDPOINT": "ENDPOINT"}, id="azure, key"),
]


def use(environment: dict[str, str], patch: pytest.MonkeyPatch, endpoint: str = "") -> None:
    """Set the environment to what is planted."""
    for name in os.environ:
        if name.startswith(("AWS_", "AZURE_")):
            patch.delenv(name)
    for name, value in environment.items():
        patch.setenv(name, value.replace("ENDPOINT", endpoint))


def chain(error: BaseException | None) -> Iterator[BaseException]:
    """An error, and all that it refers to."""
    while error is not None:
        yield error
        yield from chain(error.__cause__)
        error = error.__context__


def told(error: BaseException) -> str:
    """All that an error and those that led to it can tell."""
    texts = [f"{each} {each!r} {each.args} {getattr(each, '__notes__', '')}" for each in chain(error)]
    return "\n".join([*texts, *traceback.format_exception(error)])


@pytest.fixture
def quiet(caplog: pytest.LogCaptureFixture, capfd: pytest.CaptureFixture[str]) -> Iterator[None]:
    """Nothing that is planted is logged or printed by a test."""
    caplog.set_level(logging.DEBUG)
    yield
    printed = capfd.readouterr()
    everything = caplog.text + printed.out + printed.err
    assert not [secret for secret in PLANTED if secret in everything]


def calls(store: Bucket, folder: Path) -> list[Callable[[], object]]:
    """Everything that asks a store."""
    small, large = folder / "small", folder / "large"
    small.write_bytes(b"1")
    large.write_bytes(bytes(9 << 20))
    return [
        lambda: store.get("a"),
        lambda: store.create("a", b"1"),
        lambda: store.replace("a", b"1", Tag('"1"')),
        lambda: store.put_file("a", small),
        lambda: store.put_file("a", large),
        lambda: store.open("a"),
        lambda: store.open("a", 10).read(0, 10),
        lambda: store.local("a").__enter__(),
        lambda: store.delete(["a"]),
        lambda: list(store.entries("")),
        lambda: store.probe(),
    ]


class Echo(BaseHTTPRequestHandler):
    """Answers with a status, and tells in the body all that was asked; also of a redirect, to the address itself."""

    status = 403

    def do_GET(self) -> None:
        self.rfile.read(int(self.headers.get("Content-Length") or 0))
        body = f"<Error><Code>Odd</Code><Message>{self.path}\n{self.headers}</Message></Error>".encode()
        self.send_response(self.status)
        self.send_header("Content-Length", str(len(body)))
        self.send_header("Location", self.path if self.status == 307 else "/")
        self.end_headers()
        if self.command != "HEAD":
            self.wfile.write(body)

    do_PUT = do_POST = do_DELETE = do_HEAD = do_GET  # noqa: N815 - names of the library

    def log_message(self, *_: object) -> None:
        """Log nothing here: the addresses are those with signatures."""


@pytest.fixture
def echo() -> Iterator[str]:
    """The address of a server that echoes."""
    server = ThreadingHTTPServer(("127.0.0.1", 0), Echo)
    thread = threading.Thread(target=server.serve_forever, args=(0.02,))
    thread.start()
    yield f"http://127.0.0.1:{server.server_address[1]}"
    server.shutdown()
    thread.join()
    server.server_close()


@pytest.mark.parametrize("status", [400, 403, 404, 409, 200, 307, 503])
@pytest.mark.parametrize(("address", "environment"), STORES)
@pytest.mark.usefixtures("quiet")
@pytest.mark.long
def test_a_server_that_echoes_is_not_repeated(
    address: str,
    environment: dict[str, str],
    status: int,
    echo: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    use(environment, monkeypatch, echo)
    monkeypatch.setattr(Echo, "status", status)
    store = Bucket(address, HASTY)
    errors: list[StoreError] = []
    for call in calls(store, tmp_path):
        try:
            call()
        except StoreError as error:
            errors.append(error)
    assert len(errors) > 3
    for each in errors:
        assert not [secret for secret in (*PLANTED, "AKIAPUBLIC") if secret in told(each)]
        assert store.describe() in str(each)
    assert store.describe() == address
    assert not [secret for secret in PLANTED if secret in f"{store!r} {vars(store.open('a', 1))}"]


@pytest.mark.parametrize(
    "endpoint",
    [
        f"http://127.0.0.1:1/{PASSWORD}",
        f"http://user:{PASSWORD}@127.0.0.1:1",
        f"https://user:{PASSWORD}@127.0.0.1:1",
        f"{PASSWORD}",
        f"ftp://{PASSWORD}",
        f"http://[{PASSWORD}",
        f"http://127.0.0.1:1?sig={PASSWORD}",
    ],
)
@pytest.mark.parametrize(("address", "environment"), STORES)
@pytest.mark.usefixtures("quiet")
def test_an_endpoint_that_cannot_be_used_is_not_repeated(
    address: str, environment: dict[str, str], endpoint: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    use(environment, monkeypatch, endpoint)
    with pytest.raises(LodestreamError) as caught:
        Bucket(address, HASTY).get("a")
    assert not [secret for secret in PLANTED if secret in told(caught.value)]


@pytest.mark.parametrize(
    "setting",
    [
        {"AZURE_STORAGE_ACCOUNT_KEY": f"%{PASSWORD}"},
        {"AZURE_STORAGE_SAS_KEY": f"%{PASSWORD}&&=="},
        {"AZURE_STORAGE_ACCOUNT_NAME": f"{PASSWORD}/?"},
        {"AWS_SECRET_ACCESS_KEY": f"{PASSWORD}\n"},
        {"AWS_SESSION_TOKEN": f"{PASSWORD}\n\x01"},
        {"AWS_REGION": f"{PASSWORD}\n"},
        {"AWS_S3_EXPRESS": PASSWORD},
        {"AWS_CONDITIONAL_PUT": PASSWORD},
    ],
)
@pytest.mark.usefixtures("quiet")
def test_a_setting_that_cannot_be_used_is_not_repeated(
    setting: dict[str, str], echo: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    [name] = setting
    address, whole = ("s3://bucket", S3) if name.startswith("AWS") else ("az://container", AZURE)
    endpoint = "AWS_ENDPOINT_URL" if name.startswith("AWS") else "AZURE_STORAGE_ENDPOINT"
    use(whole | {endpoint: echo} | setting, monkeypatch)
    with pytest.raises(StoreError) as caught:
        Bucket(address, HASTY).get("a")
    assert not [secret for secret in PLANTED if secret in told(caught.value)]
