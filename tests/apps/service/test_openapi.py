"""Check the OpenAPI document: the service accepts its examples, and its schemas
match the answers."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import httpx
import jsonschema
import pytest

from topoloc.apps.service.openapi_schemas import QueryParameters


@pytest.fixture(scope="module")
def document(client: httpx.Client) -> dict[str, Any]:
    return client.get("/openapi.json").json()


OPERATIONS = {
    "explain": "localization",
    "localize": "localization",
    "localize_everywhere": "localization",
    "begin_stream": "streams",
    "end_stream": "streams",
    "localize_next": "streams",
    "get_geopose_state": "geopose",
    "localize_geopose": "geopose",
    "get_map": "maps",
    "get_scene": "maps",
    "list_maps": "maps",
    "add_note": "notes",
    "list_notes": "notes",
    "remove_note": "notes",
    "get_resolver": "discovery",
    "resolve": "discovery",
    "search": "discovery",
    "search_by_geohash": "discovery",
    "get_capabilities": "service",
    "get_health": "service",
    "get_metrics": "service",
}
"""The names that generated clients have, by their class: a change breaks the programs of users."""


def _operations(document: dict[str, Any]) -> Iterator[tuple[str, dict[str, Any]]]:
    for path, methods in document["paths"].items():
        for method, operation in methods.items():
            yield f"{method} {path}", operation


def _nodes(value: Any) -> Iterator[dict[str, Any]]:
    """Yield each object in a document."""
    if isinstance(value, dict):
        yield value
    for one in value.values() if isinstance(value, dict) else value:
        if isinstance(one, dict | list):
            yield from _nodes(one)


def _validate(document: dict[str, Any], name: str, answer: Any) -> None:
    root = {"$ref": f"#/components/schemas/{name}", "components": document["components"]}
    jsonschema.Draft202012Validator(root).validate(answer)


def test_every_route_documents_its_answers_and_errors(document: dict[str, Any]):
    for name, operation in _operations(document):
        assert operation["description"], name
        good = [one for status, one in operation["responses"].items() if status.startswith("2")]
        assert len(good) == 1, name
        for content in good[0].get("content", {}).values():
            assert content["schema"], name
        needs_token = operation.get("security", document["security"]) != []
        assert needs_token == (name != "get /healthz")
        assert ({"401", "403"} <= set(operation["responses"])) == needs_token, name


def test_generators_of_clients_find_stable_names(document: dict[str, Any]):
    found = {one["operationId"]: one["tags"] for _, one in _operations(document)}
    assert found == {name: [tag] for name, tag in OPERATIONS.items()}
    assert len(list(_operations(document))) == len(found), "a name is used twice"
    assert {tag["name"] for tag in document["tags"]} == set(OPERATIONS.values())
    assert document["components"]["securitySchemes"]["bearer"]["scheme"] == "bearer"
    assert {"bearer": []} in document["security"]


def test_every_schema_is_valid_and_every_reference_leads_to_one(document: dict[str, Any]):
    schemas = document["components"]["schemas"]
    for schema in schemas.values():
        jsonschema.Draft202012Validator.check_schema(schema)
    used = {one["$ref"] for one in _nodes(document) if isinstance(one.get("$ref"), str)}
    assert used
    assert used <= {f"#/components/schemas/{name}" for name in schemas}
    assert not any({"$defs", "if", "x-parts"} & set(one) for one in _nodes(document))
    assert {"HTTPValidationError", "ValidationError"} & set(schemas) == set(), (
        "errors have the form of `Error`"
    )


def test_the_schemas_are_those_of_the_answers(
    client: httpx.Client, asked: httpx.Client, document: dict[str, Any], view: Path, camera: str
):
    query = {"files": {"image": view.read_bytes()}, "data": {"camera": camera}}
    found = client.post("/v1/maps/earth/localize", **query).json()
    assert found["geopose"]
    for name in ("Result", "Localized"):
        _validate(document, name, found)
    with pytest.raises(jsonschema.ValidationError):
        _validate(document, "NotLocalized", found)
    _validate(document, "ResultOfMaps", asked.post("/v1/localize", **query).json())
    _validate(document, "MapNames", client.get("/v1/maps").json())
    _validate(document, "Error", client.get("/v1/maps/nowhere").json())
    begun = client.post("/v1/maps/room/sessions", params={"camera": "map"}).json()
    _validate(document, "StreamFacts", begun)
    address = f"/v1/maps/room/sessions/{begun['session']}"
    _validate(document, "Result", client.post(f"{address}/pictures", **query).json())
    assert client.delete(address).status_code == 204


@pytest.mark.parametrize("number", range(3))
def test_the_examples_of_cameras_are_accepted(
    client: httpx.Client, document: dict[str, Any], tmp_path: Path, number: int
):
    from PIL import Image

    Image.new("L", (640, 400), 90).save(tmp_path / "grey.png")
    examples = QueryParameters.model_json_schema()["properties"]["camera"]["examples"]
    prior = QueryParameters.model_json_schema()["properties"]["prior"]["examples"][0]
    said = {"camera": examples[number], "prior": prior, "max_ms": "100"}
    picture = (tmp_path / "grey.png").read_bytes()
    answer = client.post(
        "/v1/maps/room/localize",
        params=said,
        content=picture,
        headers={"content-type": "image/png"},
    )
    assert answer.status_code == 200, answer.text
    _validate(document, "NotLocalized", answer.json())
    _validate(
        document, "NotLocalized", document["components"]["schemas"]["NotLocalized"]["examples"][0]
    )
