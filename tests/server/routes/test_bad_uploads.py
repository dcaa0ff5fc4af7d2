"""What cannot be a surface, and what is too much: an answer with a reason, and nothing stored."""

from __future__ import annotations

import socket
import zipfile
from collections.abc import Iterator
from io import BytesIO
from pathlib import Path
from urllib.parse import urlsplit

import httpx
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from tests.data_folder import below
from tests.server.helpers import PATIENCE, eventually, hills, kept, npy, push

VRT = b"""<VRTDataset rasterXSize="5" rasterYSize="5"><VRTRasterBand dataType="Byte" band="1">
<SimpleSource><SourceFilename>/etc/passwd</SourceFilename></SimpleSource></VRTRasterBand></VRTDataset>"""


def stored(data: Path) -> list[str]:
    """What lies in the server's folder, once it has cleared away what it built."""
    eventually(lambda: not kept(data, "scratch/work"), "the builds' folders to be removed")
    files = sorted(str(path.relative_to(data)) for path in below(data) if path.is_file())
    return [path for path in files if not path.startswith(("scratch/index", ".lodestream/lock"))]


@pytest.mark.parametrize(
    ("body", "filename", "words"),
    [
        (b"", "empty.npy", "The file is empty"),
        (b"just some text\n", "text.tif", "just some text"),
        (VRT, "raster.tif", "VRTDataset"),
        (b"\xff\xd8\xff\xe0\x00\x10JFIF" + bytes(50), "picture.png", "ff d8 ff e0"),
        (bytes(100), "zeros", "00 00"),
    ],
)
def test_a_look_at_the_first_bytes_refuses_at_once(
    http: httpx.Client, data: Path, body: bytes, filename: str, words: str
) -> None:
    before = stored(data)
    answer = http.post("/v1/surfaces", content=body, params={"filename": filename})
    assert (answer.status_code, answer.json()["code"]) == (422, "bad-file")
    assert words in answer.json()["detail"]
    assert "\n" not in answer.json()["detail"]
    assert stored(data) == before
    assert kept(data, "scratch/incoming") == []


@pytest.mark.parametrize(
    ("query", "words"),
    [
        ({"colour": "red"}, "'colour'"),
        ({"array": "a"}, "format npy"),
        ({"closed": "maybe"}, "auto, none, rows, cols, both"),
        ({"precision": "fine"}, "'fine'"),
        ({"precision": "-1"}, "'-1'"),
        ({"precision": "nan"}, "'nan'"),
        ({"rms": "fine"}, "'fine'"),
        ({"effort": "best"}, "one of fast, default, small, and is 'best'"),
        ([("effort", "fast"), ("effort", "fast")], "twice"),
        ({"rms": "a=1"}, "'a=1'"),
        ({"rms": "1", "precision": "1"}, "not both"),
        ([("rms", "1"), ("rms", "2")], "twice"),
        ([("closed", "rows"), ("closed", "cols")], "twice"),
    ],
)
def test_options_that_do_not_exist_are_refused_at_once(
    http: httpx.Client, data: Path, query: dict[str, str], words: str
) -> None:
    before = stored(data)
    answer = http.post("/v1/surfaces", content=npy(hills()), params=query)
    assert (answer.status_code, answer.json()["code"]) == (422, "bad-option")
    assert words in answer.json()["detail"]
    assert stored(data) == before


def bomb() -> bytes:
    file = BytesIO()
    with zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("a.npy", npy(np.zeros((100, 100)))[:128] + bytes(20 << 20))
    return file.getvalue()


@pytest.mark.parametrize(
    ("body", "words"),
    [
        (npy(hills())[:200], "cut short"),
        (npy(np.zeros((1, 1))), "two points"),
        (npy(np.full((4, 4), np.nan)), "one valid point"),
        (npy(np.array([["a", "b"], ["c", "d"]])), "strings"),
        (b"v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n", "line 4"),
        (bomb(), "goes on behind its array"),
    ],
)
def test_what_only_a_reader_sees_ends_as_failed_without_its_bytes(
    http: httpx.Client, data: Path, body: bytes, words: str
) -> None:
    surface = push(http, body)
    assert surface["state"] == "failed"
    assert words in surface["reason"]
    assert "\n" not in surface["reason"]
    assert "Traceback" not in surface["reason"]
    assert str(data) not in surface["reason"]
    assert not (data / "uploads" / surface["id"]).exists()
    eventually(lambda: not kept(data, "scratch/work"), "the build's folder to be removed")


def test_what_says_that_it_is_too_large_is_refused_before_it_is_read(server: str, data: Path) -> None:
    before = stored(data)
    address = urlsplit(server)
    with socket.create_connection((address.hostname, address.port), timeout=PATIENCE) as connection:
        # Not one byte of the body is sent: the answer comes by the header alone.
        connection.sendall(b"POST /v1/surfaces HTTP/1.1\r\nHost: localhost\r\nContent-Length: 1048577\r\n\r\n")
        answer = b""
        # The server closes what it has not read to the end.
        while piece := connection.recv(65536):
            answer += piece
    assert answer.startswith(b"HTTP/1.1 413 ")
    assert b"1048577" in answer
    assert stored(data) == before


def test_a_client_that_sends_too_much_hears_why(http: httpx.Client, data: Path) -> None:
    before = stored(data)
    for _ in range(2):
        answer = http.post("/v1/surfaces", content=bytes(32 << 20))
        assert (answer.status_code, answer.json()["code"]) == (413, "too-large")
    assert stored(data) == before


def test_what_does_not_say_its_size_is_counted(http: httpx.Client, data: Path) -> None:
    before = stored(data)

    def endless() -> Iterator[bytes]:
        for _ in range(17):
            yield bytes(64 << 10)

    answer = http.post("/v1/surfaces", content=endless())
    assert (answer.status_code, answer.json()["code"]) == (413, "too-large")
    form = http.post("/v1/surfaces", files=[("file", ("a", bytes(1 << 20)))])
    assert form.status_code == 413
    assert stored(data) == before
    assert kept(data, "scratch/incoming") == []


def test_the_limit_itself_is_allowed(http: httpx.Client) -> None:
    rows = np.zeros((1 << 9, (1 << 9)), np.int32)
    body = npy(rows)[: 1 << 20]
    assert len(body) == 1 << 20
    assert push(http, body)["state"] == "failed"  # cut short by its header, but not too large


@pytest.mark.parametrize(
    ("kind", "body", "words"),
    [
        ("multipart/form-data", b"--x\r\n\r\n--x--\r\n", "boundary"),
        ("multipart/form-data; boundary=x", b"", "last boundary"),
        ("multipart/form-data; boundary=x", b"garbage", "The form cannot be read"),
        ("multipart/form-data; boundary=x", b"--x--\r\n", "file"),
        (
            "multipart/form-data; boundary=x",
            b'--x\r\nContent-Disposition: form-data; name="file"\r\n\r\nabc',
            "last bound",
        ),
        (
            "multipart/form-data; boundary=x",
            b'--x\r\nContent-Disposition: form-data; name="other"; filename="a.npy"\r\n\r\nabc\r\n--x--\r\n',
            "'other'",
        ),
        (
            "multipart/form-data; boundary=x",
            b'--x\r\nContent-Disposition: form-data; name="name"\r\n\r\nabc\r\n--x--\r\n',
            "no part called file",
        ),
        (
            "multipart/form-data; boundary=x",
            b'--x\r\nContent-Disposition: form-data; name="name"\r\n\r\n\xff\r\n--x--\r\n',
            "'name' is not text",
        ),
        (
            "multipart/form-data; boundary=x",
            b'--x\r\nContent-Disposition: form-data; name="file"\r\n\r\n\r\n--x--\r\n',
            "The file is empty",
        ),
        (
            "multipart/form-data; boundary=x",
            b"--x\r\n" + b"A" * 70000 + b': form-data; name="file"\r\n\r\nabc\r\n--x--\r\n',
            "cannot be read",
        ),
        ("multipart/form-data; boundary=" + "x" * 5000, b"", "boundary"),
    ],
)
def test_a_form_that_cannot_be_read_is_refused(
    http: httpx.Client, data: Path, kind: str, body: bytes, words: str
) -> None:
    before = stored(data)
    answer = http.post("/v1/surfaces", content=body, headers={"content-type": kind})
    assert answer.status_code == 422, answer.text
    assert words in answer.json()["detail"]
    assert stored(data) == before
    assert kept(data, "scratch/incoming") == []


def test_too_many_files_are_refused(http: httpx.Client, data: Path) -> None:
    before = stored(data)
    answer = http.post("/v1/surfaces", files=[("file", (f"{number}", b"x")) for number in range(65)])
    assert (answer.status_code, answer.json()["code"]) == (413, "too-large")
    assert "more files than the 64" in answer.json()["detail"]
    assert stored(data) == before


@settings(suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    body=st.binary(max_size=300),
    kind=st.sampled_from(["application/octet-stream", "multipart/form-data; boundary=x"]),
    start=st.sampled_from([b"", b"\x93NUMPY\x01\x00", b"PK\x03\x04", b"II*\x00", b"v 0 0 0\n", b"--x\r\n"]),
)
def test_garbage_never_upsets_the_server(http: httpx.Client, body: bytes, kind: str, start: bytes) -> None:
    answer = http.post("/v1/surfaces", content=start + body, headers={"content-type": kind})
    assert answer.status_code in (202, 422)
    if answer.status_code == 202:
        assert http.delete(answer.headers["location"]).status_code == 204


def test_a_client_that_vanishes_leaves_nothing(server: str, data: Path, http: httpx.Client) -> None:
    before = stored(data)
    address = urlsplit(server)
    for head in (b"", b"Content-Type: multipart/form-data; boundary=x\r\n"):
        with socket.create_connection((address.hostname, address.port), timeout=PATIENCE) as connection:
            connection.sendall(
                b"POST /v1/surfaces HTTP/1.1\r\nHost: x\r\nContent-Length: 1000\r\n"
                + head
                + b"\r\n"
                + npy(hills())[:500]
            )
        # The next request is answered after the first one's end has been seen.
        assert http.get("/healthz").status_code == 200
    eventually(lambda: not kept(data, "scratch/incoming"), "the half upload to be removed")
    assert stored(data) == before
