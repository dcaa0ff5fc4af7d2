"""What is done with a server in operation: a step asks for something while a call fails, and sees what came of it."""

from __future__ import annotations

import asyncio
import io
import json
from typing import Any

import httpx
import numpy as np
from numpy.typing import NDArray

from tests.server.connections.sockets import Place, Reader, read_stream
from tests.server.helpers import npy

from .forking import DIED
from .operation import Operation, Step, UnusableError
from .programs import PATIENCE

__all__ = ["STEPS"]


def _upload(work: Operation) -> None:
    body, points = work.fresh()
    with work.armed():
        surface = work.send(body, points, (202,))
        if surface is not None:
            work.talk.quiet(surface)
    if surface is None:
        # Whoever was refused sends it again. The next fault is not for its build.
        _settle(work, work.send(body, points))


def _form(work: Operation) -> None:
    body, points = work.fresh()

    def post() -> httpx.Response | None:
        return work.talk.ask("POST", "/v1/surfaces", (200, 202), files={"file": ("a.npy", body)})

    with work.armed():
        surface = work.took(post(), points)
        if surface is not None:
            work.talk.quiet(surface)
    if surface is None:
        _settle(work, work.took(post(), points))


def _settle(work: Operation, surface: str | None) -> None:
    if surface is not None:
        work.talk.quiet(surface)


def _known(work: Operation) -> None:
    body, points = work.fresh()
    first = work.sent(body, points)
    work.settle(first)
    with work.armed():
        again = work.send(body, points)
    if again not in (None, first):
        work.talk.say("wrong", f"the same bytes are another surface, {again}")
    work.talk.check(first)


def _refused(work: Operation) -> None:
    with work.armed():
        work.talk.ask("POST", "/v1/surfaces", (422,), content=b"just some text\n")
    # That nothing is listed that was never acknowledged is seen when everything is compared.


def _broken(work: Operation) -> None:
    # It begins as a surface does, so that only its build fails. Then the same comes again.
    body, _ = work.fresh()
    first = work.sent(body[:-1], None)
    work.talk.quiet(first)
    with work.armed():
        again = work.send(body[:-1], None)
        if again is not None:
            work.talk.quiet(again)
    work.talk.check(first)


def _list(work: Operation) -> None:
    surface, _ = work.upload_ready()
    with work.armed():
        listed = work.talk.ask("GET", "/v1/surfaces?limit=1000", (200,))
        work.talk.look(surface)
    if listed is not None and surface not in {entry["id"] for entry in listed.json()["surfaces"]}:
        work.talk.say("lost", f"{surface} was not listed")


def _fetch(work: Operation) -> None:
    surface, _ = work.upload_ready()
    kept = work.ledger.kept[surface]
    url = f"/v1/containers/{kept.container}.lode"
    with work.armed():
        work.talk.container(surface, kept)
        part = work.talk.ask("GET", url, (206,), headers={"range": "bytes=100-199"})
    whole = work.talk.ask("GET", url, (200,))
    if part is not None and whole is not None and part.content != whole.content[100:200]:
        work.talk.say("wrong", f"a range of {surface} has other bytes")
    work.talk.check(surface)


def _level(work: Operation) -> None:
    surface, points = work.upload_ready()
    entry = work.settle(surface)
    url = f"/v1/surfaces/{surface}/levels/{len(entry['levels']) - 1}?format=npy"
    with work.armed():
        answer = work.talk.ask("GET", url, (200,))
    for got in (answer, work.talk.ask("GET", url, (200,))):
        if got is not None and got.content != npy(points.astype(_values(got.content).dtype)):
            work.talk.say("wrong", f"the finest level of {surface} is another surface")


def _values(data: bytes) -> NDArray[Any]:
    values: NDArray[Any] = np.load(io.BytesIO(data))
    return values


def _stream(work: Operation) -> None:
    surface, _ = work.upload_ready()
    place = Place.of(f"{work.server.url}/v1/surfaces/{surface}")
    with work.armed():
        under_fault = _read(work, place)
    after = _read(work, place)
    if after is None:
        work.talk.say("lost", f"{surface} cannot be streamed")
    elif under_fault not in (None, after):
        work.talk.say("wrong", f"the stream of {surface} had other bytes")


def _read(work: Operation, place: Place) -> str | None:
    """The hash of a stream; None where it was refused or broken off."""
    try:
        reader = asyncio.run(asyncio.wait_for(read_stream(place, Reader()), PATIENCE))
    except TimeoutError:
        work.talk.say("hangs", f"the stream {place.path} does not end")
        return None
    except ConnectionError as error:
        if "not-found" in str(error):
            work.talk.say("lost", f"the stream {place.path}: {error}")
        return None
    return reader.sha256 if reader.ended == "complete" else None


def _delete(work: Operation) -> None:
    surface, _ = work.upload_ready()
    with work.armed():
        work.delete(surface)
    work.delete(surface, (204, 404))
    work.talk.check(surface)


def _delete_and_push(work: Operation) -> None:
    # Whoever does not know whether it is deleted pushes it again: what is answered then holds.
    body, points = work.fresh()
    surface = work.sent(body, points)
    work.settle(surface)
    with work.armed():
        work.delete(surface)
    _settle(work, work.send(body, points))
    work.talk.check(surface)


def _delete_shared(work: Operation) -> None:
    # The same bytes under another option are another surface with the same container.
    body, points = work.fresh()
    pair = work.sent(body, points), work.sent(body, points, {"closed": "none"})
    if work.settle(pair[0])["container_sha256"] != work.settle(pair[1])["container_sha256"]:
        raise UnusableError("the same surface has another container")
    with work.armed():
        work.delete(pair[0])
    work.delete(pair[0], (204, 404))
    work.talk.check(pair[1])


def _delete_unfinished(work: Operation) -> None:
    body, points = work.fresh()
    surface = work.sent(body, points)
    with work.armed():
        work.delete(surface)
    work.delete(surface, (204, 404))
    work.talk.check(surface)


def _retry(work: Operation) -> None:
    body, _ = work.fresh()
    surface = work.sent(body[:-1], None)
    work.talk.quiet(surface)
    with work.armed():
        if work.talk.ask("POST", f"/v1/surfaces/{surface}/retry", (200, 202, 409, 422)) is not None:
            work.talk.quiet(surface)
    work.talk.check(surface)


def _pages(work: Operation) -> None:
    with work.armed():
        for page in ("/", "/healthz", "/readyz", "/metrics"):
            work.talk.ask("GET", page, (200,))


def _token(work: Operation) -> None:
    name = f"t{next(work.numbers)}"
    place = ("--data", str(work.data), "--json")
    with work.armed():
        made = work.programs.run("token", "create", name, *place)
    if _ended(work, made.code, made.text()):
        token = json.loads(made.text())["token"]
    else:
        work.programs.run("token", "revoke", name, *place)  # it may be there: the last step of making it has failed
        made = work.programs.run("token", "create", name, *place)
        if made.code != 0:
            work.talk.say("wrong", f"no token can be made any more: {made.text()}")
            return
        token = json.loads(made.text())["token"]
    headers = {"authorization": f"Bearer {token}"}
    work.talk.ask("GET", "/v1/surfaces", (200,), headers=headers)
    work.talk.ask("GET", "/v1/surfaces", (200,))  # and the others are as they were


def _revoke(work: Operation) -> None:
    name = f"t{next(work.numbers)}"
    place = ("--data", str(work.data), "--json")
    made = work.programs.run("token", "create", name, *place)
    if made.code != 0:
        raise UnusableError(f"no token can be made, and no call fails: {made.text()}")
    headers = {"authorization": f"Bearer {json.loads(made.text())['token']}"}
    with work.armed():
        revoked = work.programs.run("token", "revoke", name, *place)
    if _ended(work, revoked.code, revoked.text()) or work.programs.run("token", "revoke", name, *place).code == 0:
        work.talk.ask("GET", "/v1/surfaces", (403,), headers=headers)
    work.talk.ask("GET", "/v1/surfaces", (200,))


def _ended(work: Operation, code: int | None, text: str) -> bool:
    """Whether a command has done what it was to do; a line that says why is as good."""
    if code is None:
        work.talk.say("hangs", f"the command does not end: {text[-300:]}")
    elif code == DIED or code < 0:
        work.talk.say("answer", f"the command died: {text[-300:]}")
    return code == 0


STEPS: dict[str, Step] = {
    "upload": _upload,
    "form": _form,
    "known": _known,
    "refused": _refused,
    "broken": _broken,
    "list": _list,
    "fetch": _fetch,
    "level": _level,
    "stream": _stream,
    "delete": _delete,
    "delete and push": _delete_and_push,
    "delete shared": _delete_shared,
    "delete unfinished": _delete_unfinished,
    "retry": _retry,
    "pages": _pages,
    "token create": _token,
    "token revoke": _revoke,
}
