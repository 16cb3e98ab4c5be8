"""What OpenAPI says of the service holds: its examples are accepted, its schemas are those of the
answers."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import httpx
import jsonschema
import pytest

from topoloc.apps.service.openapi_schemas import QueryParameters


@pytest.fixture(scope="module")
def document(client: httpx.Client) -> dict[str, Any]:
    return client.get("/openapi.json").json()


def test_every_route_says_what_it_answers_and_refuses(document: dict[str, Any]):
    assert {
        "/v1/maps",
        "/v1/maps/{map}/localize",
        "/v1/localize",
        "/localize/geopose",
        "/healthz",
        "/metrics",
    } <= set(document["paths"])
    for path, methods in document["paths"].items():
        for method, facts in methods.items():
            assert facts["description"], (path, method)
            assert any(status.startswith("2") for status in facts["responses"]), (path, method)
    assert "$defs" not in json.dumps(document)


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
    responses = document["paths"]["/v1/maps/{map}/localize"]["post"]["responses"]
    schema = responses["200"]["content"]["application/json"]["schema"]
    jsonschema.validate(answer.json(), schema)
    jsonschema.validate(schema["examples"][0], schema)
