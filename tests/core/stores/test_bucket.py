"""What a bucket adds to the contract: requests, headers, parts, and the traps of its library."""

from __future__ import annotations

import http.client
import os
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import ClassVar
from urllib.parse import quote

import obstore
import pytest
from obstore.store import S3Store

from lodestream.errors import LodestreamError
from lodestream.stores import AbsentError, DeniedError, Store, StoreError, Tag, UnfitStoreError, open_store
from lodestream.stores.answers import ask
from lodestream.stores.bucket import Bucket
from lodestream.stores.connections import Limits
from lodestream.stores.headers import headers
from tests.patience import PATIENCE
from tests.stores.emulators import Emulator
from tests.stores.faults import Fault, FaultProxy, fault_proxy


@pytest.fixture
def proxy(s3: Emulator, monkeypatch: pytest.MonkeyPatch) -> Iterator[FaultProxy]:
    """What counts the requests to S3."""
    with fault_proxy(s3.port) as proxy:
        monkeypatch.setenv(s3.endpoint, s3.at(proxy.port)[s3.endpoint])
        yield proxy


def put(store: Store, key: str, data: bytes, folder: Path) -> None:
    (folder / "source").write_bytes(data)
    store.put_file(key, folder / "source")


def test_a_whole_read_by_small_slices_takes_at_most_four_requests_for_each_megabyte(
    s3: Emulator, proxy: FaultProxy, tmp_path: Path
) -> None:
    data = bytes(range(256)) * (5_100_000 // 256)
    store = open_store(s3.address())
    put(store, "containers/a.lode", data, tmp_path)
    proxy.seen.clear()
    with store.open("containers/a.lode", len(data)) as blob:
        read = b"".join(blob.read(offset, 16 << 10) for offset in range(0, len(data), 16 << 10))
    assert read == data
    assert len(proxy.seen) <= 4 * len(data) / 1e6


def test_streams_of_one_object_share_its_blocks(s3: Emulator, proxy: FaultProxy, tmp_path: Path) -> None:
    data = bytes(2_350_000)
    store = open_store(s3.address())
    put(store, "containers/a.lode", data, tmp_path)
    proxy.seen.clear()
    for _ in range(50):
        with store.open("containers/a.lode", len(data)) as blob:
            for offset in range(0, len(data), 100_000):
                assert len(blob.read(offset, 100_000)) == min(100_000, len(data) - offset)
    assert len(proxy.seen) == 6


def test_a_write_is_one_request_and_a_large_file_several(s3: Emulator, proxy: FaultProxy, tmp_path: Path) -> None:
    store = open_store(s3.address())
    tag = store.create("a", b"1")
    store.replace("a", b"2", tag)
    put(store, "b", bytes(8 << 20), tmp_path)
    assert [each.partition(" ")[0] for each in proxy.seen] == ["PUT"] * 3
    proxy.seen.clear()
    put(store, "c", bytes((16 << 20) + 1), tmp_path)
    assert sorted(each.partition(" ")[0] for each in proxy.seen) == ["POST"] * 2 + ["PUT"] * 3


def unfinished(s3: Emulator, store: Store) -> bool:
    """Return whether there are parts of uploads to a store; others of its bucket are those of other tests."""
    listed = answer(s3, "/tests?uploads")[1]
    assert b"ListMultipartUploadsResult" in listed
    return f"<Key>{store.describe().removeprefix('s3://tests/')}/".encode() in listed


def test_an_upload_that_is_stopped_leaves_no_parts(s3: Emulator, tmp_path: Path) -> None:
    store = open_store(s3.address())
    (tmp_path / "source").write_bytes(bytes(30 << 20))

    begun = []

    def stop(done: int) -> None:
        if done > 20 << 20:
            begun.append(unfinished(s3, store))
            raise ValueError("stopped")

    with pytest.raises(ValueError, match="stopped"):
        store.put_file("a", tmp_path / "source", stop)
    assert begun == [True]
    assert not unfinished(s3, store)
    assert list(store.entries("")) == []


@pytest.mark.skipif(sys.platform == "win32", reason="sends a signal")
@pytest.mark.usefixtures("interrupts")
def test_an_upload_that_is_interrupted_leaves_no_parts(s3: Emulator, tmp_path: Path) -> None:
    store = open_store(s3.address())
    (tmp_path / "source").write_bytes(bytes(40 << 20))

    def interrupt(done: int) -> None:
        if done == 16 << 20:
            os.kill(os.getpid(), signal.SIGINT)
            time.sleep(1)  # as long as a part takes

    with pytest.raises(KeyboardInterrupt):
        store.put_file("a", tmp_path / "source", interrupt)
    assert not unfinished(s3, store)
    assert list(store.entries("")) == []


@pytest.mark.skipif(sys.platform == "win32", reason="sends a signal")
@pytest.mark.usefixtures("interrupts")
@pytest.mark.parametrize(
    "call",
    [
        "get('a')",
        "create('a', b'')",
        "put_file('a', sys.argv[0])",
        "delete(['a', 'b'])",
        "delete(map(str, range(100)))",
        "open('a', 100).read(0, 100)",
        "open('a', 10 ** 7).read(0, 10)",  # and the block behind
        "open('a', 10 ** 7).read(0, 10 ** 7)",
    ],
)
def test_a_store_that_does_not_answer_can_be_interrupted(call: str, tmp_path: Path) -> None:
    script = tmp_path / "script.py"
    script.write_text(
        f"""
import sys
from lodestream.stores.bucket import Bucket
from lodestream.stores.connections import Limits
Bucket("s3://bucket/a", Limits(*[{2 * PATIENCE}] * 3, again={2 * PATIENCE})).{call}
"""
    )
    with socket.create_server(("127.0.0.1", 0)) as silent:
        place = f"http://127.0.0.1:{silent.getsockname()[1]}"
        credentials = {"AWS_ACCESS_KEY_ID": "a", "AWS_SECRET_ACCESS_KEY": "b", "AWS_ENDPOINT_URL": place}
        running = subprocess.Popen(
            [sys.executable, script], env={**os.environ, **credentials}, stderr=subprocess.PIPE, text=True
        )
        connection, _ = silent.accept()
        with connection:
            assert connection.recv(1)
            running.send_signal(signal.SIGINT)
            said = running.communicate(timeout=PATIENCE)[1]  # below the limits of the store
    assert running.returncode != 0
    assert "KeyboardInterrupt" in said


def test_a_delete_that_failed_deletes_nothing_afterwards(s3: Emulator, monkeypatch: pytest.MonkeyPatch) -> None:
    store, begun, other, gate = Bucket(s3.address()), list[str](), threading.Event(), threading.Event()

    def delete(_: object, at: str) -> None:
        name = at.rpartition("/")[2]
        begun.append(name)
        if name == "0":
            assert other.wait(PATIENCE)
            threading.Timer(0.3, gate.set).start()
            raise PermissionError("status code: 403")
        other.set()
        assert gate.wait(PATIENCE)

    monkeypatch.setattr(obstore, "delete", delete)
    with pytest.raises(DeniedError, match="refuses access"):
        store.delete(map(str, range(100)))
    assert gate.is_set(), "those under way are waited for"
    assert len(begun) < 100, "others do not begin"


def test_a_delete_is_made_again_only_while_it_may_be_and_never_by_the_library(s3: Emulator, proxy: FaultProxy) -> None:
    store = Bucket(s3.address(), Limits(pause=0.01))
    store.create("a", b"1")
    asked: list[int] = []

    def still() -> float:
        asked.append(sum(line.startswith(("DELETE", "POST")) for line in proxy.seen))
        if len(asked) == 3:
            raise LodestreamError("over")
        return 10.0

    proxy.faults = [Fault("503", where="DELETE|POST")]
    with pytest.raises(LodestreamError, match="over"):
        store.delete(["a"], still)
    assert asked == [0, 1, 2], "it is asked before each request"
    proxy.faults = []
    assert store.get("a")[0] == b"1"


def test_a_delete_takes_no_longer_than_it_may(s3: Emulator, proxy: FaultProxy) -> None:
    store = Bucket(s3.address(), Limits(2 * PATIENCE, 2 * PATIENCE, again=0.0, delete=2.0))
    proxy.faults = [Fault("hung", where="DELETE|POST")]
    begun = time.monotonic()
    with pytest.raises(StoreError, match="does not answer"):
        store.delete(["a"], lambda: 2.0)
    assert time.monotonic() - begun < PATIENCE, "other requests may take longer"
    assert len(proxy.seen) == 1
    with pytest.raises(StoreError, match="not enough time left"):
        store.delete(["a"], lambda: 1.9)
    assert len(proxy.seen) == 1


def answer(s3: Emulator, target: str) -> tuple[dict[str, str], bytes]:
    """Headers and body of what S3 answers to a GET without credentials, as browsers ask."""
    connection = http.client.HTTPConnection("127.0.0.1", s3.port, timeout=PATIENCE)
    connection.request("GET", target)
    response = connection.getresponse()
    found = {name.lower(): value for name, value in response.getheaders()}, response.read()
    connection.close()
    return found


@pytest.mark.parametrize(
    ("key", "kind", "kept"),
    [
        ("containers/0a.lode", "application/vnd.lodestream.container", "public, max-age=31536000, immutable"),
        ("other/0a.lode", "application/vnd.lodestream.container", "no-cache"),
        ("view.json", "application/json", "no-cache"),
        ("index.html", "text/html; charset=utf-8", "no-cache"),
        ("assets/page-1a.js", "text/javascript; charset=utf-8", "no-cache"),
        ("assets/page-1a.css", "text/css; charset=utf-8", "no-cache"),
        ("assets/kernels.wasm", "application/wasm", "no-cache"),
        ("a.svg", "image/svg+xml", "no-cache"),
        ("a.png", "image/png", "no-cache"),
        ("levels/3.tif", "image/tiff", "no-cache"),
        ("a.gz", "application/octet-stream", "no-cache"),
        ("uploads/0a/1", "application/octet-stream", "no-cache"),
        ("a.b/c", "application/octet-stream", "no-cache"),
    ],
)
def test_headers_follow_from_the_key(key: str, kind: str, kept: str) -> None:
    assert headers(key) == {"Content-Type": kind, "Cache-Control": kept}


@pytest.mark.parametrize("size", [10, 9 << 20])
def test_headers_are_kept_by_the_store_and_there_is_no_encoding(s3: Emulator, size: int, tmp_path: Path) -> None:
    store = open_store(s3.address())
    put(store, "containers/0a.lode", bytes(size), tmp_path)
    found, body = answer(s3, f"/tests/{store.describe().removeprefix('s3://tests/')}/containers/0a.lode")
    assert found["content-type"] == "application/vnd.lodestream.container"
    assert found["cache-control"] == "public, max-age=31536000, immutable"
    assert not found.get("content-encoding")
    assert len(body) == size


def test_objects_of_other_programs_are_not_listed(s3: Emulator) -> None:
    store = open_store(s3.address())
    store.create("a/b", b"1")
    prefix = store.describe().removeprefix("s3://tests/")
    for name in ("", "marker/", "with space", ".hidden", "a/.b"):
        connection = http.client.HTTPConnection("127.0.0.1", s3.port, timeout=PATIENCE)
        connection.request("PUT", f"/tests/{prefix}/{name.replace(' ', '%20')}", body=b"")
        assert connection.getresponse().status == 200
        connection.close()
    assert [entry.key for entry in store.entries("")] == ["a/b", "marker"]
    assert [entry.key for entry in store.entries("a/")] == ["a/b"]


@pytest.mark.sweep(2)
@pytest.mark.parametrize(
    ("name", "told"),
    [("a//x", "a//x"), ("a/../x", "a/../x"), ("a/./x", "a/./x"), ("a/b\nc", r"a/b\\nc"), ('a/"\x7f', r'a/\\"\\u{7f}')],
)
def test_an_object_of_another_program_that_cannot_be_listed_is_named(s3: Emulator, name: str, told: str) -> None:
    store = open_store(s3.address())
    store.create("a/b", b"1")
    prefix = store.describe().removeprefix("s3://tests/")
    connection = http.client.HTTPConnection("127.0.0.1", s3.port, timeout=PATIENCE)
    connection.request("PUT", f"/tests/{prefix}/{quote(name)}", body=b"")
    assert connection.getresponse().status == 200
    connection.close()
    with pytest.raises(StoreError) as refused:
        list(store.entries("a/"))
    assert f"because of the object '{prefix}/{told}', of whose key a part is empty" in str(refused.value)
    assert "delete that object" in str(refused.value)
    assert store.get("a/b")[0] == b"1"


class Refusing(BaseHTTPRequestHandler):
    """Answers 200 to DeleteObjects, with each of some errors once."""

    codes: ClassVar[list[str]] = []

    def do_POST(self) -> None:
        self.rfile.read(int(self.headers["content-length"]))
        errors = [f"<Error><Key>p/a</Key><Code>{code}</Code><Message>no</Message></Error>" for code in self.codes[:1]]
        del self.codes[:1]
        body = f"<DeleteResult>{''.join(errors or ['<Deleted><Key>p/a</Key></Deleted>'])}</DeleteResult>"
        self.send_response(200)
        self.send_header("content-length", str(len(body)))
        self.end_headers()
        self.wfile.write(body.encode())

    def log_message(self, *_: object) -> None:
        """Print nothing."""


def test_a_delete_that_is_refused_says_so_at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    with ThreadingHTTPServer(("127.0.0.1", 0), Refusing) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        for name, value in {
            "AWS_ACCESS_KEY_ID": "a",
            "AWS_SECRET_ACCESS_KEY": "b",
            "AWS_REGION": "us-east-1",
            "AWS_ENDPOINT_URL": f"http://127.0.0.1:{server.server_port}",
        }.items():
            monkeypatch.setenv(name, value)
        store = Bucket("s3://bucket/p", Limits(again=PATIENCE, pause=0.01))
        monkeypatch.setattr(Refusing, "codes", ["AccessDenied", "AccessDenied"])
        with pytest.raises(StoreError, match=r"refuses access \(AccessDenied\)"):
            store.delete(["a"])
        assert Refusing.codes == ["AccessDenied"], "it is asked once"
        monkeypatch.setattr(Refusing, "codes", ["SlowDown", "InternalError"])
        store.delete(["a"])  # since these may pass
        assert not Refusing.codes
        server.shutdown()


def test_stores_of_one_bucket_do_not_see_each_other(s3: Emulator) -> None:
    inner = open_store(s3.address())
    outer = open_store(inner.describe().rpartition("/")[0])
    beside = open_store(inner.describe() + "2")
    inner.create("a", b"1")
    assert [entry.key for entry in outer.entries("")] == ["store/a"]
    assert list(beside.entries("")) == []
    with pytest.raises(AbsentError):
        beside.get("a")


def test_more_objects_than_a_page_of_a_list_are_listed(s3: Emulator) -> None:
    store = open_store(s3.address())
    own = S3Store("tests", prefix=store.describe().removeprefix("s3://tests/"), client_options={"allow_http": True})
    keys = [f"{number:04}" for number in range(1100)]
    for key in keys:
        obstore.put(own, key, b"")
    assert [entry.key for entry in store.entries("")] == keys
    assert [entry.key for entry in store.entries("", "1050")] == keys[1051:]
    store.delete(keys)
    assert list(store.entries("")) == []


@pytest.mark.parametrize("scheme", ["s3", "azure"])
def test_a_bucket_that_is_not_there_is_not_an_absent_object(scheme: str, request: pytest.FixtureRequest) -> None:
    emulator: Emulator = request.getfixturevalue(scheme)
    store = Bucket(f"{emulator.scheme}://nothing/a", Limits(retries=0, again=0.0))
    for call in (
        lambda: store.get("a"),
        lambda: store.open("a"),
        lambda: store.create("a", b""),
        lambda: store.replace("a", b"", Tag('"1"')),
        lambda: list(store.entries("")),
    ):
        with pytest.raises(
            StoreError, match=r"no such bucket or container \(404 (NoSuchBucket|ContainerNotFound)\)"
        ) as e:
            call()
        assert not isinstance(e.value, AbsentError)


def test_an_object_that_comes_to_be_while_it_is_opened_is_absent(s3: Emulator, monkeypatch: pytest.MonkeyPatch) -> None:
    address, head = s3.address(), obstore.head
    store, other = open_store(address), open_store(address)

    def late(bucket: S3Store, at: str) -> object:
        try:
            return head(bucket, at)
        finally:
            other.create("a.json", b"{}")

    monkeypatch.setattr(obstore, "head", late)
    with pytest.raises(AbsentError):
        store.open("a.json")
    monkeypatch.undo()
    with store.open("a.json") as blob:
        assert blob.read(0, 2) == b"{}"


def test_a_tag_is_no_hash_of_a_large_object(s3: Emulator, tmp_path: Path) -> None:
    store = open_store(s3.address())
    put(store, "a", bytes(9 << 20), tmp_path)
    assert store.get("a")[1].endswith('-2"')


def test_a_store_without_tags_is_unfit(s3: Emulator) -> None:
    store = Bucket(s3.address())
    with pytest.raises(UnfitStoreError, match="gives no tags"):
        store._tag(None)


class PanicException(BaseException):
    """As the library raises it, for one, from `get_ranges` past the end of an object."""


def test_a_panic_of_the_library_is_an_error_of_the_store(
    s3: Emulator, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture, tmp_path: Path
) -> None:
    store = Bucket(s3.address(), Limits(again=PATIENCE))
    put(store, "a", b"1", tmp_path)
    panics = iter([PanicException("index out of range")])

    def panic(*_: object, **__: object) -> bytes:
        for error in panics:
            raise error
        return b"1"

    monkeypatch.setattr(obstore, "get_range", panic)
    with store.open("a") as blob:
        assert blob.read(0, 1) == b"1", "it is tried once more"
    assert "the library for buckets failed: PanicException" in caplog.text
    assert "index" not in caplog.text
    panics = iter(PanicException() for _ in range(100))
    store = Bucket(store.describe(), Limits(again=0.2))
    with store.open("a", 1000) as blob, pytest.raises(StoreError, match="does not answer"):
        blob.read(0, 1)


def test_interrupts_are_no_failures() -> None:
    def interrupted() -> None:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        ask(interrupted)


@pytest.mark.skipif(sys.platform == "win32", reason="there is no fork")
def test_a_forked_process_is_told_that_it_may_not_use_the_library(s3: Emulator) -> None:
    script = f"""
import os, sys, warnings
from lodestream.stores import StoreError, Tag, open_store
warnings.simplefilter("ignore")
store = open_store({s3.address()!r})
tag = store.create("a", b"1")
store.put_file("b", sys.executable)
blob = store.open("b")
blob.read(0, 10)
store.delete(["c", "d"])
if os.fork() == 0:
    for name, call in {{
        "get": lambda: store.get("a"),
        "create": lambda: store.create("e", b"1"),
        "replace": lambda: store.replace("a", b"2", tag),
        "put_file": lambda: store.put_file("e", sys.executable),
        "open": lambda: store.open("b"),
        "read": lambda: store.open("a", 1).read(0, 1),
        "read of a block that is there": lambda: blob.read(0, 10),
        "read of a block that is not there": lambda: blob.read(blob.size - 10, 10),
        "read at once": lambda: blob.read_at_once(0, 10),
        "pieces": lambda: list(store.pieces("b")),
        "local": lambda: store.local("b").__enter__(),
        "delete": lambda: store.delete(["a"]),
        "delete of several": lambda: store.delete(["a", "b", "c"]),
        "entries": lambda: list(store.entries("")),
        "probe": lambda: store.probe(),
        "open_store": lambda: open_store({s3.address()!r}),
    }}.items():
        try:
            call()
        except StoreError as error:
            if "before this process was forked" in str(error):
                continue
        print(name, "is possible", flush=True)
    print("ended", flush=True)
    os._exit(0)
os.wait()
print(sorted(entry.key for entry in store.entries("")))
"""
    ran = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, timeout=PATIENCE, check=True)
    assert ran.stdout == "ended\n['a', 'b']\n"
