"""Uploading, looking, listing, deleting; and what the server says of itself."""

from __future__ import annotations

import hashlib
import json
import re
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import pytest

import lodestream as ls
from lodestream_server.routes import surfaces as routes
from lodestream_server.store import layout
from tests.server.helpers import eventually, hills, kept, npy, problem, push, settled, upload_of


def test_an_upload_becomes_a_surface(http: httpx.Client, data: Path) -> None:
    body = npy(hills())
    answer = http.post("/v1/surfaces", content=body, params={"filename": "hills.npy", "name": "Hills"})
    assert answer.status_code == 202
    location = answer.headers["location"]
    accepted = answer.json()
    assert re.fullmatch("[0-9a-f]{20}", accepted["id"])
    assert location == accepted["url"] == f"/v1/surfaces/{accepted['id']}"
    surface = settled(http, location)
    assert surface["state"] == "ready"
    assert surface["progress"] == 1.0
    assert surface["reason"] is None
    assert surface["name"] == "Hills"
    assert surface["filenames"] == ["hills.npy"]
    assert surface["upload_bytes"] == len(body)
    assert surface["shape"] == [40, 30]
    assert surface["closed"] == [False, False]
    assert surface["blocks"] == [{"shape": [40, 30], "closed": [False, False]}]
    assert surface["exact"] is True
    assert surface["metadata"]["name"] == "Hills"
    assert [level["level"] for level in surface["levels"]] == list(range(len(surface["levels"])))
    assert surface["layers"][-1]["bytes"] <= surface["bytes"]
    container = http.get(f"{location}/container", follow_redirects=True).content
    assert len(container) == surface["bytes"]
    assert hashlib.sha256(container).hexdigest() == surface["container_sha256"]
    assert np.array_equal(ls.decode(container).points, hills())
    small = (data / "built" / f"{surface['id']}.json").read_bytes()
    built = layout.parse(layout.Built, layout.built_key(surface["id"]), small)
    assert (built.container, built.container_bytes) == (surface["container_sha256"], surface["bytes"])
    # The description is sent as it is stored, behind what the server says of the surface, and nothing is said twice.
    answer = http.get(location)
    assert answer.content.endswith(b", " + built.info[1:])
    keys = [key for key, _ in json.loads(answer.content, object_pairs_hook=list)]
    assert len(keys) == len(set(keys))


def test_options_come_in_the_query_or_in_a_form(http: httpx.Client) -> None:
    body = npy(hills(seed=31))
    made = push(http, body, precision="0.25", name="Hills", closed="none")
    fields = {"precision": "0.25", "name": "Hills", "closed": "none"}
    for form, query in ((fields, {}), ({"name": "Hills"}, {"precision": "0.25", "closed": "none"})):
        again = http.post("/v1/surfaces", data=form, params=query, files={"file": ("hills.npy", body)})
        assert (again.status_code, again.json()["id"]) == (200, made["id"]), again.text
        assert again.json()["options"] == {"precision": "0.25", "closed": "none"}
    refused = http.post("/v1/surfaces", data=fields, params={"name": "Hills"}, files={"file": ("hills.npy", body)})
    assert problem(refused) == (422, "bad-option")
    assert "'name' is given twice" in refused.json()["detail"]
    for form in ({"no-option": "1"}, {"name": "x" * 5000}, {f"option{n}": "1" for n in range(65)}):
        refused = http.post("/v1/surfaces", data=form, files={"file": ("hills.npy", body)})
        assert refused.status_code in (413, 422), refused.text


def test_what_a_client_has_of_a_description_is_not_sent_again(http: httpx.Client) -> None:
    made = push(http, npy(hills(seed=32)), name="one")
    http.put("/v1/names/tagged", json={"surface": made["id"]})
    for path in (made["url"], "/v1/surfaces", "/v1/names", "/v1/names/tagged", "/v1/formats"):
        answer = http.get(path)
        etag = answer.headers["etag"]
        assert answer.headers["cache-control"] == "private, no-cache"
        unchanged = http.get(path, headers={"if-none-match": etag})
        assert (unchanged.status_code, unchanged.content, unchanged.headers["etag"]) == (304, b"", etag)
        assert http.head(path).headers["etag"] == etag
    etags = {path: http.get(path).headers["etag"] for path in ("/v1/surfaces", "/v1/names")}
    other = push(http, npy(hills(seed=33)))
    http.put("/v1/names/tagged", json={"surface": other["id"]})
    for path, etag in etags.items():
        assert http.get(path, headers={"if-none-match": etag}).status_code == 200, "it says something else now"
    http.delete("/v1/names/tagged")


def test_unknown_parameters_are_refused_with_those_that_there_are(http: httpx.Client) -> None:
    made = push(http, npy(hills(seed=34)))
    for method, path, words in (
        ("GET", "/v1/surfaces?limit=3&befor=x", "'befor' here, only limit, after, thumbnails"),
        ("GET", f"{made['url']}?x=1", "only thumbnails, wait"),
        ("GET", f"{made['url']}/levels/1?fromat=npy", "only format"),
        ("GET", f"{made['url']}/container?x", "and no other"),
        ("GET", f"{made['url']}/map.json?x=", "only encoding"),
        ("GET", f"/v1/containers/{made['container_sha256']}.lode?x=1", "and no other"),
        ("GET", "/v1/formats?x=1", "and no other"),
        ("POST", f"{made['url']}/retry?x=1", "and no other"),
        ("DELETE", f"{made['url']}?x=1", "and no other"),
        ("DELETE", "/v1/names/none?x=1", "and no other"),
        ("POST", "/v1/surfaces?x=1", "no option 'x'"),
    ):
        refused = http.request(method, path, content=npy(hills(seed=34)) if path.startswith("/v1/surfaces?x") else None)
        assert problem(refused) == (422, "bad-option"), path
        assert words in refused.json()["detail"], refused.text
    assert http.get(made["url"]).status_code == 200
    wrong = http.get("/v1/surfaces?limit=0").json()["detail"]
    assert wrong == "The parameter limit of the query must be at least 1, and is '0'"


def test_the_same_bytes_and_options_are_the_same_surface(http: httpx.Client) -> None:
    body = npy(hills(seed=2))
    first = push(http, body, precision="0.5", filename="a.npy")
    again = http.post("/v1/surfaces", content=body, params={"precision": "5e-1", "filename": "another.npy"})
    assert again.status_code == 200
    assert again.headers["location"] == first["url"]
    assert again.json()["id"] == first["id"]
    form = http.post("/v1/surfaces", files=[("file", ("b.npy", body))], params={"precision": "0.50"})
    assert (form.status_code, form.json()["id"]) == (200, first["id"])
    others = [
        push(http, body)["id"],
        push(http, body, precision="0.25")["id"],
        push(http, body, closed="rows")["id"],
        push(http, body, precision="0.5", name="another name")["id"],
    ]
    assert len({first["id"], *others}) == 5


def test_a_root_mean_square_error_is_part_of_the_surface(http: httpx.Client) -> None:
    body = npy(hills(seed=2))
    first = push(http, body, rms="1%")
    assert first["options"] == {"rms": "1%"}
    assert first["exact"] is False
    assert 0 < first["layers"][-1]["rms"] <= 0.01 * float(np.ptp(hills(seed=2).astype(float)))
    again = http.post("/v1/surfaces", content=body, params={"rms": "1.0%"})
    assert (again.status_code, again.json()["id"]) == (200, first["id"])
    others = [push(http, body, **{key: "2%"})["id"] for key in ("rms", "precision")]
    assert len({first["id"], *others}) == 3


def test_an_effort_is_part_of_the_surface(http: httpx.Client) -> None:
    heights = hills(seed=4)
    first = push(http, npy(heights), effort="small")
    assert first["options"] == {"effort": "small"}
    container = http.get(first["url"] + "/container", follow_redirects=True).content
    assert container == ls.encode(ls.decode(container), effort="small") != ls.encode(ls.decode(container))
    plain = push(http, npy(heights))
    again = http.post("/v1/surfaces", content=npy(heights), params={"effort": "default"})
    assert (again.status_code, again.json()["id"]) == (200, plain["id"])
    assert len({first["id"], plain["id"], push(http, npy(heights), effort="fast")["id"]}) == 3


def test_options_reach_the_surface(http: httpx.Client) -> None:
    surface = push(http, npy(hills(seed=3)), closed="both", precision="1%")
    assert surface["closed"] == [True, True]
    assert surface["exact"] is False
    assert surface["options"] == {"closed": "both", "precision": "1%"}


def test_options_of_a_format_reach_its_reader(http: httpx.Client, tmp_path: Path) -> None:
    path = tmp_path / "two.npz"
    np.savez(path, low=hills(8, 9, seed=4), high=hills(10, 11, seed=4))
    shapes = [push(http, path.read_bytes(), array=name)["shape"] for name in ("low", "high")]
    assert shapes == [[8, 9], [10, 11]]


def test_files_may_come_as_parts_of_a_form(http: httpx.Client) -> None:
    body = npy(hills(seed=5))
    answer = http.post("/v1/surfaces", files=[("file", ("../../étrange\n.npy", body))])
    assert answer.status_code == 202
    surface = settled(http, answer.headers["location"])
    assert surface["state"] == "ready"
    assert "/" not in surface["filenames"][0]
    assert surface["filenames"][0].endswith(".npy")


def test_several_files_of_one_surface_are_taken_and_told_apart(http: httpx.Client) -> None:
    one, two = npy(hills(seed=6)), npy(hills(seed=7))
    answers = [
        http.post("/v1/surfaces", files=[("file", ("1.npy", first)), ("file", ("2.npy", second))])
        for first, second in ((one, two), (two, one))
    ]
    assert [answer.status_code for answer in answers] == [202, 202]
    surfaces = [settled(http, answer.headers["location"]) for answer in answers]
    assert surfaces[0]["id"] != surfaces[1]["id"]
    # No format takes several files yet, and whoever reads them says so.
    assert all(surface["state"] == "failed" and "one file" in surface["reason"] for surface in surfaces)


def test_a_bad_file_fails_with_its_reason_and_keeps_its_upload(http: httpx.Client, data: Path) -> None:
    surface = push(http, npy(hills(seed=8))[:-100], filename="cut.npy")
    assert surface["state"] == "failed"
    assert "cut short" in surface["reason"]
    assert "\n" not in surface["reason"]
    assert kept(data, f"uploads/{upload_of(data, surface).name}") == ["0"], "a retry needs it"
    for path in ("/container", "/levels/0"):
        answer = http.get(surface["url"] + path)
        assert (answer.status_code, answer.json()["code"]) == (409, "failed")
        assert "cut short" in answer.json()["detail"]
    again = http.post("/v1/surfaces", content=npy(hills(seed=8))[:-100], params={"filename": "cut.npy"})
    assert again.status_code == 202
    assert settled(http, again.headers["location"])["state"] == "failed"


def test_nothing_but_holes_fails_with_its_reason(http: httpx.Client) -> None:
    surface = push(http, npy(np.full((4, 5), np.nan)))
    assert surface["state"] == "failed"
    assert "at least one valid point" in surface["reason"]


def test_a_deleted_surface_is_gone_with_all_its_bytes(http: httpx.Client, data: Path) -> None:
    surface = push(http, npy(hills(seed=10)))
    upload = upload_of(data, surface)
    assert upload.is_dir()
    assert http.delete(surface["url"]).status_code == 204
    assert http.get(surface["url"]).status_code == 404
    assert http.delete(surface["url"]).status_code == 404
    for path in (
        f"surfaces/{surface['id']}.json",
        f"built/{surface['id']}.json",
        f"uploads/{upload.name}",
        f"containers/{surface['container_sha256']}.lode",
    ):
        assert not (data / path).exists()
    assert http.get(f"/v1/containers/{surface['container_sha256']}.lode").status_code == 404


def test_a_container_that_two_surfaces_share_stays_until_both_are_gone(http: httpx.Client) -> None:
    body = npy(hills(seed=11))
    one, two = push(http, body, name="same"), push(http, body, name="same", closed="none")
    assert one["id"] != two["id"]
    assert one["container_sha256"] == two["container_sha256"]
    address = f"/v1/containers/{one['container_sha256']}.lode"
    http.delete(one["url"])
    assert http.get(address).status_code == 200
    http.delete(two["url"])
    assert http.get(address).status_code == 404


def test_the_list_comes_in_pages_without_gaps(http: httpx.Client) -> None:
    made = [push(http, npy(hills(5, 5, seed=20 + number)))["id"] for number in range(5)]
    seen: list[str] = []
    address: str | None = "/v1/surfaces?limit=2"
    while address:
        document = http.get(address).raise_for_status().json()
        assert len(document["surfaces"]) <= 2
        unlisted = {"filenames", "options", "layers", "levels", "metadata"}
        assert not any(unlisted & surface.keys() for surface in document["surfaces"])
        seen += [surface["id"] for surface in document["surfaces"]]
        address = document["next"]
    assert len(seen) == len(set(seen))
    assert [name for name in seen if name in made] == made
    assert [entry["id"] for entry in http.get("/v1/surfaces?limit=1000").json()["surfaces"]] == seen


def test_a_page_ends_after_so_many_bytes(http: httpx.Client, monkeypatch: pytest.MonkeyPatch) -> None:
    made = [push(http, npy(hills(5, 5, seed=30 + number)), name="ä" * 255)["id"] for number in range(5)]
    monkeypatch.setattr(routes, "_MOST_PAGE", 3000)
    seen: list[str] = []
    sizes: list[int] = []
    address: str | None = "/v1/surfaces?limit=1000"
    while address:
        answer = http.get(address).raise_for_status()
        seen += [surface["id"] for surface in answer.json()["surfaces"]]
        sizes.append(len(answer.content))
        address = answer.json()["next"]
    # What goes beyond is one surface.
    assert len(sizes) > 2
    assert max(sizes) < 3000 + 2000
    assert len(seen) == len(set(seen))
    assert [name for name in seen if name in made] == made


def test_a_surface_without_a_name_has_that_of_its_file(http: httpx.Client) -> None:
    body, named = npy(hills(seed=14)), ls.encode(ls.Surface(hills(seed=14), metadata={"name": "Told"}))
    surfaces = [
        push(http, body, filename="ridge.npy", precision="0.5"),
        push(http, body, filename="ridge.npy", name="Ridge"),
        push(http, body, closed="none"),
        push(http, named, filename="a.lode"),
        push(http, body[:-1], filename="cut.npy"),
    ]
    names = {surface["id"]: surface["name"] for surface in surfaces}
    assert list(names.values()) == ["ridge", "Ridge", None, "Told", "cut.npy"]
    listed = http.get("/v1/surfaces?limit=1000").json()["surfaces"]
    assert {entry["id"]: entry["name"] for entry in listed if entry["id"] in names} == names


@pytest.mark.parametrize("query", ["limit=0", "limit=x", "limit=1001", "after=yesterday"])
def test_a_page_that_does_not_exist_is_refused(http: httpx.Client, query: str) -> None:
    answer = http.get(f"/v1/surfaces?{query}")
    assert (answer.status_code, answer.json()["code"]) == (422, "bad-option")
    assert query.partition("=")[0] in answer.json()["detail"]


def test_every_get_has_its_head(http: httpx.Client) -> None:
    surface = push(http, npy(hills(seed=12)))
    for path in (
        "/",
        "/healthz",
        "/v1/surfaces",
        surface["url"],
        f"{surface['url']}/container",
        f"{surface['url']}/levels/2",
        f"/v1/containers/{surface['container_sha256']}.lode",
    ):
        got, head = http.get(path), http.head(path)
        assert head.status_code == got.status_code
        assert head.content == b""
        assert head.headers["content-length"] == got.headers["content-length"]


def test_what_the_server_says_of_itself(http: httpx.Client) -> None:
    assert http.get("/healthz").json()["status"] == "ok"
    eventually(lambda: http.get("/readyz").status_code == 200, "the server to be ready")
    page = http.get("/")
    assert page.headers["content-type"].startswith("text/html")
    assert "Lodestream" in page.text  # whether the page of the browser is built or not
    assert http.get("/docs").status_code == 200


def test_problems_have_one_shape(http: httpx.Client) -> None:
    for answer, status, words in (
        (http.get("/nowhere"), 404, "No such address on this server: '/nowhere'"),
        (http.get("/v1/surfaces/0123"), 404, "'0123'"),
        (http.get("/v1/surfaces/" + "x" * 500), 404, "No surface 'xxx"),
        (http.get("/v1/surfaces/..%2f..%2fetc"), 404, "encoded slash"),
        (http.get(f"/v1/containers/{'0' * 64}.lode"), 404, "No container '000"),
        (http.get("/v1/containers/..%2f..%2fsurfaces.lode"), 404, "encoded slash"),
        (http.put("/v1/surfaces"), 405, "GET, HEAD, POST"),
        (http.post("/healthz"), 405, "GET, HEAD"),
        (http.get("/v1/surfaces/"), 404, "No such address"),
    ):
        assert answer.status_code == status, answer.url
        assert answer.headers["content-type"] == "application/problem+json"
        document: dict[str, Any] = answer.json()
        assert set(document) == {"type", "title", "status", "code", "detail", "instance"}
        assert document["status"] == status
        assert words in document["detail"]
        page, _, place = document["type"].partition("#")
        assert (place, http.get(page).status_code) == (document["code"], 200)
        assert f'<h2 id="{place}">' in http.get(page).text
    assert http.put("/v1/surfaces").headers["allow"] == "GET, HEAD, POST"


def test_operations_have_names_for_generated_clients(http: httpx.Client) -> None:
    paths = http.get("/openapi.json").json()["paths"]
    names = [operation["operationId"] for operations in paths.values() for operation in operations.values()]
    assert len(names) == len(set(names))
    assert all(re.fullmatch("[a-z]+_[a-z_]+", name) for name in names), names
    ours = {"upload_surface", "list_surfaces", "get_surface", "delete_surface", "get_name", "get_surface_map_json"}
    assert ours <= set(names)


def test_openapi_describes_every_route(http: httpx.Client) -> None:
    schema = http.get("/openapi.json").json()
    assert set(schema["paths"]) == {
        "/healthz",
        "/readyz",
        "/metrics",
        "/v1/formats",
        "/v1/surfaces",
        "/v1/surfaces/{surface}",
        "/v1/surfaces/{surface}/retry",
        "/v1/surfaces/{surface}/container",
        "/v1/surfaces/{surface}/stream",
        "/v1/surfaces/{surface}/levels/{level}",
        "/v1/containers/{sha256}.lode",
        "/v1/names",
        "/v1/names/{name}",
        "/v1/names/{name}/container",
        "/v1/uploads",
        "/v1/uploads/{upload}",
        *(
            f"/v1/{kind}/{{surface}}/{path}"
            for kind in ("surfaces", "names")
            for path in (
                "map.json",
                "tiles/{z}/{x}/{y}.{image}",
                "terrain/layer.json",
                "terrain/{z}/{x}/{y}.terrain",
            )
        ),
    }
    for path, operations in schema["paths"].items():
        for operation in operations.values():
            parameters = {it["name"] for it in operation.get("parameters", ()) if it["in"] == "path"}
            assert parameters == set(re.findall(r"{(\w+)}", path)), path
    post = schema["paths"]["/v1/surfaces"]["post"]
    assert {"application/octet-stream", "multipart/form-data"} == set(post["requestBody"]["content"])
    assert {parameter["name"] for parameter in post["parameters"]} >= {
        "precision",
        "rms",
        "effort",
        "closed",
        "name",
        "filename",
    }
    assert set(post["responses"]) == {"200", "202", "401", "403", "408", "413", "422", "429", "503", "507"}
    text = json.dumps(schema)
    assert "HTTPValidationError" not in text
    for name in re.findall(r"#/components/schemas/(\w+)", text):
        assert name in schema["components"]["schemas"]
