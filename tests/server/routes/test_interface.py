"""Very many requests made from the OpenAPI document: what it says is what happens, and nothing fails inside."""

from __future__ import annotations

import itertools
import logging
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import httpx
import pytest
import requests
import schemathesis
from hypothesis import given
from hypothesis import strategies as st
from schemathesis import CheckFunction
from schemathesis.core.result import Ok
from schemathesis.specs.openapi.checks import negative_data_rejection, positive_data_acceptance

from lodestream_server import Settings, create_app, running_server
from tests.patience import PATIENCE
from tests.server.helpers import eventually, hills, npy, push

SCHEMA = schemathesis.openapi.from_dict(create_app(Settings(data=Path("nowhere"))).openapi())
OPERATIONS = {
    f"{operation.method.upper()} {operation.path}": operation
    for operation in (result.ok() for result in SCHEMA.get_all_operations() if isinstance(result, Ok))
}
schemathesis.serializer.alias("application/offset+octet-stream", "application/octet-stream")
POSITIVE, NEGATIVE = schemathesis.GenerationMode.POSITIVE, schemathesis.GenerationMode.NEGATIVE

#: Of what has tiles if it has a CRS.
MAPS = {name for name in OPERATIONS if "/map.json" in name or "/tiles/" in name or "/terrain/" in name}

#: What no schema can say: whether bytes are a surface, how many levels one has, whether it lies on the Earth.
INDESCRIBABLE = {
    "POST /v1/surfaces",
    "GET /v1/surfaces/{surface}/levels/{level}",
    *MAPS,
}

#: The same, of uploads in parts; what a schema can say is answered 412, as their protocol has it.
RESUMABLE = {"POST /v1/uploads", "PATCH /v1/uploads/{upload}", "POST /v1/uploads/{upload}"}

#: What httpx and requests do not speak: whatever they ask there is answered 426.
STREAM = "GET /v1/surfaces/{surface}/stream"

#: Where something can be wrong that a schema does say; any text may be the name of a surface.
FALLIBLE = {"GET /v1/surfaces", "GET /v1/names", "GET /v1/names/{name}", "PUT /v1/names/{name}", *INDESCRIBABLE}

CASES = [(name, POSITIVE) for name in OPERATIONS] + [(name, NEGATIVE) for name in sorted(FALLIBLE)]


@dataclass
class Server:
    """A server with one surface and one name that stay, and others to be had."""

    url: str
    http: httpx.Client
    stays: dict[str, Any]

    def __post_init__(self) -> None:
        self._seeds = itertools.count(100)
        self._name("stays")

    def real(self, method: str) -> dict[str, str]:
        """Path parameters of something that there is."""
        surface = self.stays
        if method == "delete":
            answer = self.http.post("/v1/surfaces", content=npy(hills(3, 4, seed=next(self._seeds))))
            surface = {**answer.json(), "container_sha256": ""}
        name = self._name(f"name-{next(self._seeds)}") if method == "delete" else "stays"
        return {"surface": surface["id"], "sha256": surface["container_sha256"], "name": name}

    def _name(self, name: str) -> str:
        assert self.http.put(f"/v1/names/{name}", json={"surface": self.stays["id"]}).status_code == 201
        return name


@pytest.fixture(scope="module")
def server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Server]:
    with (
        running_server(tmp_path_factory.mktemp("data"), workers=1, upload_bytes=1 << 20) as url,
        httpx.Client(base_url=url, trust_env=False, timeout=PATIENCE) as http,
    ):
        eventually(lambda: http.get("/readyz").status_code == 200, "the server to be ready")
        yield Server(url, http, push(http, npy(hills(40, 30))))


@pytest.mark.parametrize(("name", "mode"), CASES, ids=[f"{name}, {mode.value}" for name, mode in CASES])
def test_what_the_document_says_is_what_happens(
    server: Server, name: str, mode: schemathesis.GenerationMode, caplog: pytest.LogCaptureFixture
) -> None:
    operation = OPERATIONS[name]
    excluded: list[CheckFunction] = []
    if name in INDESCRIBABLE | RESUMABLE or name == STREAM:
        excluded.append(positive_data_acceptance)
    if name == "POST /v1/surfaces":
        # In a form the number 0 is the text 0, and that may be the beginning of a surface.
        excluded.append(negative_data_rejection)
    statuses: Counter[int] = Counter()
    caplog.set_level(logging.ERROR)
    with requests.Session() as session:
        session.trust_env = False

        @given(case=operation.as_strategy(generation_mode=mode), real=st.integers(0, 3))
        def ask(case: schemathesis.Case[Any], real: int) -> None:
            if real == 0:
                known = server.real(operation.method)
                case.path_parameters = {key: known.get(key, value) for key, value in case.path_parameters.items()}
                if case.media_type == "application/octet-stream":
                    case.body = npy(hills(4, 5))
                if case.media_type == "application/json":
                    case.body = {"surface": server.stays["id"]}
            answer = case.call(base_url=server.url, session=session, allow_redirects=False)
            statuses[answer.status_code] += 1
            case.validate_response(answer, excluded_checks=excluded)

        ask()
    assert statuses.total() > 0
    assert max(statuses) < 500
    assert [record.getMessage() for record in caplog.records if record.levelno >= logging.ERROR] == []


@pytest.mark.parametrize("name", OPERATIONS)
def test_no_two_parameters_of_a_query_are_described_alike(name: str) -> None:
    parameters = [it.definition for it in OPERATIONS[name].query]
    described = [it["description"] for it in parameters]
    assert len(set(described)) == len(described), described


def test_what_is_answered_with_a_tag_may_be_answered_that_the_client_has_it(server: Server) -> None:
    parts = {"level": 0, "z": 0, "x": 0, "y": 0, "image": "png", **server.real("get")}
    tagged = set(MAPS)  # the surface has no CRS, and so none of these
    for name, operation in OPERATIONS.items():
        if operation.method == "get" and "etag" in server.http.get(operation.path.format(**parts)).headers:
            tagged.add(name)
    assert len(tagged) > len(MAPS) + 6
    for name in tagged:
        assert "304" in OPERATIONS[name].definition.raw["responses"], name
