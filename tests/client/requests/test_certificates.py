"""A host whose certificate is not trusted: what is said, and what is done about it."""

from __future__ import annotations

import asyncio
import socket
import ssl
import threading
from collections.abc import Iterator
from pathlib import Path

import httpx
import pytest

import lodestream as ls
from lodestream_client import Client, UnreachableError
from lodestream_client.requests.problems import from_connection
from tests.patience import PATIENCE
from tests.server.proxies import self_signed


@pytest.fixture
def host(tmp_path: Path) -> Iterator[str]:
    """The address of a host with a certificate that nobody has signed but itself."""
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    context.load_cert_chain(*self_signed(tmp_path))
    with socket.create_server(("127.0.0.1", 0)) as listener:

        def answer() -> None:
            while True:
                try:
                    taken, _ = listener.accept()
                except OSError:
                    return
                with taken:
                    taken.settimeout(PATIENCE)
                    try:
                        context.wrap_socket(taken, server_side=True).close()
                    except OSError:
                        continue

        thread = threading.Thread(target=answer)
        thread.start()
        try:
            yield f"https://127.0.0.1:{listener.getsockname()[1]}"
        finally:
            listener.shutdown(socket.SHUT_RDWR)
            thread.join()


def test_a_certificate_that_is_not_trusted_is_told_as_such(host: str) -> None:
    told = "no secure .*certificate is not trusted here .self.signed certificate.; .* SSL_CERT_FILE .* in place"
    with Client(host) as client, pytest.raises(UnreachableError, match=told):
        list(client.list())
    with Client(host) as client, pytest.raises(UnreachableError, match=told):
        list(client.connect(f"{host}/v1/surfaces/hill"))
    with pytest.raises(UnreachableError, match=told):
        ls.open(f"{host}/hill.lode")


def test_the_authorities_of_the_environment_take_the_place_of_the_usual_ones(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Which is what the message about a certificate says of them."""
    certificate, _ = self_signed(tmp_path)
    monkeypatch.setenv("SSL_CERT_FILE", str(certificate))
    assert len(httpx.create_ssl_context().get_ca_certs()) == 1


def test_an_answer_that_does_not_come_is_no_fault_of_the_certificate(tmp_path: Path) -> None:
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    context.load_cert_chain(*self_signed(tmp_path))

    async def ask() -> None:
        over = asyncio.Event()

        async def take(_: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
            await over.wait()
            writer.transport.abort()

        timeout = httpx.Timeout(PATIENCE, read=0.01)
        async with await asyncio.start_server(take, "127.0.0.1", 0, ssl=context) as server:
            url = f"https://127.0.0.1:{server.sockets[0].getsockname()[1]}"
            async with httpx.AsyncClient(verify=False, trust_env=False, timeout=timeout) as http:
                with pytest.raises(httpx.ReadTimeout) as raised:
                    await http.get(url)
            over.set()
        assert str(from_connection(raised.value, url)) == f"no answer from {url} in time"

    asyncio.run(ask())
