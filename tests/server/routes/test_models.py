"""Real answers against the models of the OpenAPI document: nothing is told that they lack, and nothing lacks."""

from __future__ import annotations

import io
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import pytest
from jsonschema import Draft202012Validator
from openapi_spec_validator import OpenAPIV31SpecValidator

import lodestream as ls
from lodestream_server import Settings, create_app, problems, running_server
from lodestream_server.access.tokens import TokenFile
from lodestream_server.codes import MEANINGS
from lodestream_server.routes.models import schemas
from tests.server import manual
from tests.server.helpers import PATIENCE, hills, npy, push

DOCUMENT = create_app(Settings(data=Path("nowhere"))).openapi()
#: With no key more than the models have.
STRICT = {
    "components": {
        "schemas": {
            name: {**schema, "additionalProperties": False}
            for name, schema in DOCUMENT["components"]["schemas"].items()
        }
    }
}
_WORD = re.compile(r"\{\w+\}")


def wrong(schema: dict[str, Any], value: Any) -> list[str]:
    """What a schema of the document does not allow of a value."""
    found = Draft202012Validator(STRICT | schema).iter_errors(value)
    return [f"{error.json_path}: {error.message}" for error in found]


def model(name: str) -> dict[str, Any]:
    return {"$ref": f"#/components/schemas/{name}"}


def checked(answer: httpx.Response) -> Any:
    """The JSON of an answer, which is as the document says of its operation, status and type."""
    path = answer.request.url.path
    (operations,) = [
        them for it, them in DOCUMENT["paths"].items() if re.fullmatch(_WORD.sub("[^/]+", it).replace(".", r"\."), path)
    ]
    told = operations[answer.request.method.lower()]["responses"][str(answer.status_code)]
    schema = told["content"][answer.headers["content-type"]]["schema"]
    assert set(schema) == {"$ref"}
    value = answer.json()
    assert wrong(schema, value) == [], path
    return value


@pytest.fixture(scope="module")
def http(tmp_path_factory: pytest.TempPathFactory) -> Iterator[httpx.Client]:
    """A client with a token, which is told of owners; larger surfaces than hills wait."""
    folder = tmp_path_factory.mktemp("models")
    token, _ = TokenFile(folder / "tokens.json").create("ci", ("admin",))
    head = {"authorization": f"Bearer {token}"}
    with (
        running_server(folder / "data", workers=1, token_file=folder / "tokens.json", max_vertices=100 * 120) as url,
        httpx.Client(base_url=url, headers=head, trust_env=False, timeout=PATIENCE) as made,
    ):
        yield made


def test_the_document_is_one_of_openapi() -> None:
    OpenAPIV31SpecValidator(DOCUMENT).validate()


def test_the_page_is_made_from_the_document() -> None:
    assert manual.HTTP_PATH.read_text() == manual.render_http(), "run python -m tests.server.manual"


def test_every_answer_in_json_has_a_model() -> None:
    for path, operations in DOCUMENT["paths"].items():
        for method, operation in operations.items():
            for status, answer in operation["responses"].items():
                for kind, content in answer.get("content", {}).items():
                    assert ("$ref" in content["schema"]) == kind.endswith("json"), (path, method, status)


def test_the_examples_of_the_models_are_of_their_models() -> None:
    examples = [(name, each) for name, schema in schemas().items() for each in schema.get("examples", ())]
    assert {"Surface", "SurfacePage", "NamePage", "Problem"} <= {name for name, _ in examples}
    for name, example in examples:
        assert wrong(model(name), example) == [], name


def test_what_the_models_lack_is_found() -> None:
    example = schemas()["NamePage"]["examples"][0]
    assert wrong(model("NamePage"), {**example, "more": 1})
    assert wrong(model("NamePage"), {"names": [{**example["names"][0], "more": 1}], "next": None})
    assert wrong(model("NamePage"), {"names": []})


def test_surfaces_in_each_state_and_of_each_kind(http: httpx.Client) -> None:
    queued = checked(http.post("/v1/surfaces", content=npy(hills(seed=1)), params={"precision": "0.1%", "name": "a"}))
    assert queued["state"] in ("queued", "building")
    assert queued["owner"] == "ci"
    assert checked(http.get(queued["url"], params={"wait": 60}))["state"] == "ready"
    assert checked(http.post("/v1/surfaces", content=npy(hills(seed=1)), params={"precision": "0.1%", "name": "a"}))

    archive = io.BytesIO()
    np.savez(archive, low=hills(6, 9), high=hills(8, 5))
    failed = push(http, archive.getvalue(), filename="two.npz")
    assert len(checked(http.get(failed["url"]))["choices"]) == 2
    assert checked(http.post(f"{failed['url']}/retry"))["state"] in ("queued", "building")

    waiting = push(http, npy(np.zeros((400, 400), np.float32)))
    assert checked(http.get(waiting["url"]))["state"] == "waiting"

    side = np.stack([*np.mgrid[0:5, 0:6], hills(5, 6)], axis=-1)
    surface = ls.Surface(
        blocks=[ls.Block(side + shift, attributes={"heat": hills(5, 6)}) for shift in (0.0, 100.0)],
        metadata={"series": {"name": "run", "along": "time", "index": 3, "value": 0.5, "unit": "s"}},
    )
    several = checked(http.get(push(http, ls.encode(surface), filename="several.lode")["url"]))
    assert (several["shape"], len(several["blocks"]), several["attributes"]) == (None, 2, ["heat"])
    assert len(several["channel_names"]) == several["channels"]
    assert len(several["layers"][0]["channels"]) == several["channels"]
    assert several["errors"] == "checked"

    for query in ({}, {"thumbnails": "true"}, {"limit": "1"}):
        page = checked(http.get("/v1/surfaces", params=query))
        assert ("thumbnail" in page["surfaces"][0]) == ("thumbnails" in query)
        assert (page["next"] is None) == ("limit" not in query)
    assert any("series" in it for it in checked(http.get("/v1/surfaces"))["surfaces"])


def test_names(http: httpx.Client) -> None:
    first, second = (push(http, npy(hills(seed=seed))) for seed in (21, 22))
    assert wrong(model("Pointing"), {"surface": first["url"]}) == wrong(model("Pointing"), {"surface": None}) == []
    assert checked(http.put("/v1/names/dem", json={"surface": first["url"]}))["id"] == first["id"]
    assert checked(http.put("/v1/names/dem", json={"surface": second["id"]}))["id"] == second["id"]
    assert checked(http.get(first["url"]))["replaced_until"]
    assert checked(http.get("/v1/names/dem"))["id"] == second["id"]
    assert [it["name"] for it in checked(http.get("/v1/names"))["names"]] == ["dem"]
    assert checked(http.put("/v1/names/dem", json={"surface": second["id"], "more": 1}))["code"] == "bad-input"


def test_documents_of_the_service_and_of_maps(http: httpx.Client) -> None:
    pytest.importorskip("pyproj")
    from lodestream.maps import crs_wkt

    for path in ("/healthz", "/readyz", "/v1/formats"):
        assert checked(http.get(path))
    place = {"crs": crs_wkt("EPSG:4326"), "geotransform": [7, 0.01, 0, 46, 0, -0.01]}
    hill = push(http, ls.encode(ls.Surface(hills(100, 120), metadata=place)), filename="hill.lode")
    http.put("/v1/names/hill", json={"surface": hill["id"]}).raise_for_status()
    for path in (hill["url"], "/v1/names/hill"):
        assert checked(http.get(f"{path}/map.json"))["encoding"] == "mapbox"
        assert "encoding" not in checked(http.get(f"{path}/map.json", params={"encoding": "shade"}))
        assert checked(http.get(f"{path}/terrain/layer.json"))["available"]


def test_problems(http: httpx.Client) -> None:
    surface = push(http, npy(hills(seed=41)))["url"]
    stranger = {"authorization": "Bearer nobody"}
    asked = [
        http.get("/v1/surfaces", headers=stranger),
        http.get("/v1/surfaces/0123"),
        http.get("/v1/surfaces?limit=0"),
        http.get("/v1/surfaces?lines=3"),
        http.post("/v1/surfaces", content=b"nothing that is known"),
        http.get(f"{surface}/levels/99"),
        http.get(f"{surface}/stream"),
        http.get(f"{surface}/container", headers={"range": "bytes=99999999-"}),
        http.get(f"{surface}/map.json"),
        http.put("/v1/names/dem", content=b"["),
        http.post("/v1/uploads"),
        http.patch("/v1/uploads/0123", headers={"tus-resumable": "1.0.0"}),
    ]
    told = [checked(answer) for answer in asked]
    assert [it["status"] for it in told] == [401, 404, 422, 422, 422, 422, 426, 416, 422, 422, 412, 404]
    for code in MEANINGS:
        assert wrong(model("Problem"), problems.document(code, "why", "", None)) == []
