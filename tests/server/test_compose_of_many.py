"""docker/compose.scale.yaml, its services as processes of this machine: the same commands, variables and Caddyfile."""

from __future__ import annotations

import hashlib
import http.client
import os
import re
import subprocess
import sys
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

import httpx
import pytest

from tests.patience import PATIENCE
from tests.server.helpers import eventually, hills, npy, settled
from tests.server.proxies import Front, caddy_of_many, missing
from tests.stores.emulators import Emulator, ministack, s3

__all__ = ["ministack", "s3"]

ROOT = Path(__file__).parents[2]
#: What takes the place of the image's own interpreter and commands.
PATH = os.pathsep.join([str(Path(sys.executable).parent), os.environ["PATH"]])


def services() -> dict[str, Any]:
    """The services of the file, by name."""
    yaml = pytest.importorskip("yaml")
    found: dict[str, Any] = yaml.safe_load((ROOT / "docker/compose.scale.yaml").read_text())["services"]
    return found


def variables(service: dict[str, Any], emulator: Emulator, scratch: Path) -> dict[str, str]:
    """The variables of a service, which lead to the store and the folders of this machine."""
    named = {name: str(value) for name, value in service["environment"].items()}
    assert named["AWS_SECRET_ACCESS_KEY"].startswith("${LODESTREAM_STORE_PASSWORD:?")
    named |= {"AWS_ENDPOINT_URL": emulator.environment["AWS_ENDPOINT_URL"], "AWS_SECRET_ACCESS_KEY": "secret"}
    if "LODESTREAM_SCRATCH" in named:
        named["LODESTREAM_SCRATCH"] = str(scratch)
        named["LODESTREAM_TRUSTED_PROXIES"] += ",127.0.0.1"
    own = {name: value for name, value in os.environ.items() if not name.startswith(("AWS_", "LODESTREAM_"))}
    return {**own, **named, "PATH": PATH, "PYTHONPATH": os.pathsep.join(filter(None, sys.path))}


@contextmanager
def serving(named: dict[str, str]) -> Iterator[tuple[str, subprocess.Popen[str]]]:
    """A server as the image starts it, at a free port of this machine."""
    command = re.search(r"(?m)^CMD (\[.*\])$", (ROOT / "docker/Dockerfile").read_text())
    assert command is not None
    assert command[1] == '["serve", "--host", "0.0.0.0", "--port", "8000"]'
    words = ["lodestream", "serve", "--host", "127.0.0.1", "--port", "0"]
    with subprocess.Popen(words, env=named, stderr=subprocess.PIPE, text=True) as process:
        try:
            assert process.stderr is not None
            lines = iter(process.stderr.readline, "")
            found = (re.search(r"serving http://(127\.0\.0\.1:\d+)", line) for line in lines)
            yield next(match[1] for match in found if match), process
        finally:
            process.kill()


def role(place: str) -> str:
    return str(httpx.get(f"http://{place}/readyz", trust_env=False, timeout=PATIENCE).json()["role"])


@pytest.mark.long
def test_one_writes_another_takes_over_and_readers_answer(s3: Emulator, tmp_path: Path) -> None:
    if missing("caddy"):
        pytest.skip("it is not installed")
    known = services()
    connection = http.client.HTTPConnection("127.0.0.1", s3.port, timeout=PATIENCE)
    connection.request("PUT", "/surfaces", headers={"Content-Length": "0"})  # as `bucket` does
    assert connection.getresponse().status == 200
    connection.close()
    asked = variables(known["token"], s3, tmp_path)
    once, again = (
        subprocess.run(known["token"]["entrypoint"], env=asked, capture_output=True, text=True, check=True).stdout
        for _ in range(2)
    )
    token = once.split()[-1]
    assert token not in again
    names = ("writer", "standby", "reader-1", "reader-2")
    with ExitStack() as stack:
        started = {name: stack.enter_context(serving(variables(known[name], s3, tmp_path / name))) for name in names}
        places = {name: place for name, (place, _) in started.items()}

        def roles() -> list[str]:
            return [role(places[name]) for name in names]

        eventually(lambda: roles() == ["writer", "waiting", "reader", "reader"], "one to write")
        front = stack.enter_context(
            caddy_of_many(
                tmp_path / "caddy",
                [places["writer"], places["standby"]],
                [places["reader-1"], places["reader-2"]],
            )
        )
        with front.client(token) as client:
            assert client.get("/metrics").status_code == 403
            stored(front, client, 1)
            sent_in_parts(client)
            writer = started["writer"][1]
            writer.terminate()
            writer.wait(PATIENCE)
            eventually(lambda: role(places["standby"]) == "writer", "the other to take over")
            stored(front, client, 2)
            eventually(lambda: len(client.get("/v1/surfaces").json()["surfaces"]) == 2, "the readers to know both")


def sent_in_parts(client: httpx.Client) -> None:
    """Ask how far an upload is that is sent in parts: only the server that writes knows."""
    begun = client.post("/v1/uploads", headers={"tus-resumable": "1.0.0", "upload-length": "7"})
    assert begun.status_code == 201, begun.text
    for _ in range(6):
        told = client.head(begun.headers["location"], headers={"tus-resumable": "1.0.0"})
        assert (told.status_code, told.headers["upload-offset"]) == (200, "0")


def stored(front: Front, client: httpx.Client, seed: int) -> None:
    """Upload a surface, and read it until each reader has it."""

    def upload() -> httpx.Response | None:
        answer = client.post("/v1/surfaces", content=npy(hills(90, 70, seed)), params={"filename": "hills.npy"})
        return answer if answer.status_code == 202 else None  # 503 until Caddy has seen who writes

    uploaded = eventually(upload, "a server to take it")
    place = uploaded.headers["location"]
    assert [client.get(place).status_code for _ in range(6)] == [200] * 6, "no reader has to follow before"
    surface = settled(client, place)
    assert surface["state"] == "ready"
    for _ in range(6):
        answer = client.get(f"{surface['url']}/container")
        assert answer.status_code == 200, answer.text
        assert hashlib.sha256(answer.content).hexdigest() == surface["container_sha256"]
