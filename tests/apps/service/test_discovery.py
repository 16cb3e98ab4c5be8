"""Test discovery by SpatialDDS 1.6: only searches in the area of a map find the service."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Any

import httpx
import pytest
from hypothesis import given, strategies as st
from jsonschema import Draft202012Validator
from running_service import Running, running

from schemas import strict_object
from topoloc.apps.service.protocols.discovery_messages import (
    Announced,
    boxes_intersect,
    enclose,
    geohash_box,
    parse_resource,
)

SEARCH = "/.well-known/spatialdds/search"
HERE = [4.69, 50.86, 4.71, 50.88]
_NUMBER, _TEXT = {"type": "number"}, {"type": "string"}
_TIME = strict_object(sec={"type": "integer"}, nanosec={"type": "integer"})
# The rules of 8.1, 8.2.3 and 3.3.4 in words of our own.
MANIFEST = strict_object(
    id=_TEXT | {"pattern": r"^spatialdds://[A-Za-z0-9.-]+/[A-Za-z0-9:_-]+/service/[A-Za-z0-9_-]+$"},
    profile={"const": "spatial.manifest@1.6"},
    rtype={"const": "service"},
    service=strict_object(
        service_id=_TEXT,
        kind={"const": "VPS"},
        name=_TEXT,
        version=_TEXT,
        connection={"type": "object"},
        topics={"type": "array"},
        hints={"type": "array", "items": strict_object(key=_TEXT, value=_TEXT)},
    ),
    coverage=strict_object(
        frame_ref=strict_object(uuid=_TEXT, fqn={"const": "earth-fixed"}),
        has_bbox={"const": True},
        bbox={"type": "array", "items": _NUMBER, "minItems": 4, "maxItems": 4},
        has_aabb={"const": False},
        **{"global": {"const": False}},
    ),
    stamp=_TIME,
    ttl_sec={"type": "integer", "minimum": 1},
)


def _search(client: httpx.Client, **query: Any) -> list[dict[str, Any]]:
    reply = client.post(SEARCH, json=query)
    assert reply.status_code == 200, reply.text
    assert reply.json()["next_page_token"] == ""
    return reply.json()["results"]


def test_a_search_finds_the_map_and_the_address_of_its_service(
    asked: httpx.Client, open_service: Running
):
    (manifest,) = _search(asked, coverage=[{"type": "bbox", "crs": "EPSG:4979", "bbox": HERE}])
    Draft202012Validator(MANIFEST).validate(manifest)
    west, south, east, north = manifest["coverage"]["bbox"]
    assert HERE[0] < west < 4.70 < east < HERE[2]
    assert HERE[1] < south < 50.87 < north < HERE[3]
    (hint,) = manifest["service"]["hints"]
    assert hint["value"] == f"{open_service.url}/localize/geopose?map=earth"
    assert asked.get(hint["value"]).json() == {"status": "running"}


@pytest.mark.parametrize(
    "query",
    [
        {"geohash": "u15"},
        {"geohash": "u15", "kind": ["MAPPING", "VPS"]},
        {"coverage": [{"bbox": [0, 0, 1, 1]}, {"bbox": HERE}]},
        {"coverage": [{"global": True}]},
        {"coverage": [{"type": "volume", "aabb": {"min_xyz": [4, 50, 0], "max_xyz": [5, 51, 9]}}]},
        {"coverage": [{"bbox": HERE, "frame_ref": {"uuid": "5", "fqn": "earth-fixed"}}]},
        {"coverage": [{"bbox": [170, -90, 165, 90]}]},
        {"geohash": "u15", "filter": {"type_in": []}, "unknown": 5},
    ],
    ids=str,
)
def test_a_search_in_the_area_finds_the_service(asked: httpx.Client, query: dict[str, Any]):
    assert [one["service"]["service_id"] for one in _search(asked, **query)] == ["earth"]


@pytest.mark.parametrize(
    "query",
    [
        {"geohash": "9q8yy"},
        {"geohash": "u15", "kind": ["MAPPING"]},
        {"geohash": "u15", "filter": {"type_in": ["geopose"]}},
        {"coverage": [{"bbox": [4.71, 50.86, 4.73, 50.88]}]},
        {"coverage": [{"bbox": HERE, "frame_ref": {"uuid": "5", "fqn": "map/hall"}}]},
        {"coverage": [{"bbox": HERE, "has_bbox": False, "global": False, "aabb":
            {"min_xyz": [8, 50, 0], "max_xyz": [9, 51, 9]}}]},
    ],
    ids=str,
)  # fmt: skip
def test_a_search_elsewhere_or_of_another_service_finds_nothing(
    asked: httpx.Client, query: dict[str, Any]
):
    assert _search(asked, **query) == []


@pytest.mark.parametrize(
    ("query", "fault"),
    [
        ({}, "coverage or geohash is missing"),
        ({"geohash": "u1"}, "geohash"),
        ({"geohash": "u15aaa"}, "geohash"),
        ({"geohash": "u151u151"}, "geohash"),
        ({"geohash": "u15", "kind": ["vps"]}, "kind.0"),
        ({"geohash": "u15", "max_results": 0}, "max_results"),
        ({"geohash": "u15", "page_token": "next"}, "page_token"),
        ({"coverage": [{}]}, "coverage.0: a region has"),
        ({"coverage": [{"global": True}] * 65}, "at most 64"),
        ({"coverage": [{"bbox": [4, 50, 5]}]}, "coverage.0.bbox"),
        ({"coverage": [{"bbox": [4, 51, 5, 50]}]}, "west, south, east, north"),
        ({"coverage": [{"bbox": HERE, "crs": "EPSG:3857"}]}, "crs"),
        ([], "search"),
    ],
    ids=str,
)
def test_a_search_that_makes_no_sense_is_a_400(asked: httpx.Client, query: object, fault: str):
    refused = asked.post(SEARCH, json=query)
    assert refused.status_code == 400
    assert fault in refused.json()["error"]


@pytest.mark.parametrize("body", [b"", b"{", b'{"coverage": [{"bbox": [4, NaN, 5, 51]}]}'])
def test_a_search_that_is_no_json_is_a_400(asked: httpx.Client, body: bytes):
    assert asked.post(SEARCH, content=body).status_code == 400


def test_the_short_form_has_the_same_content(asked: httpx.Client):
    (by_post,) = _search(asked, geohash="u15")
    by_get = asked.get(SEARCH, params={"geohash": "u15", "kind": "VPS"})
    assert [one["id"] for one in by_get.json()["results"]] == [by_post["id"]]
    assert "max-age" in by_get.headers["cache-control"]
    assert asked.get(SEARCH, params={"geohash": "u15", "kind": "CONTENT"}).json()["results"] == []
    for params in ({}, {"geohash": "A"}, {"geohash": "u15", "kind": "HOTEL"}):
        assert asked.get(SEARCH, params=params).status_code == 400


def test_an_identifier_leads_to_the_manifest(asked: httpx.Client):
    resolver = asked.get("/.well-known/spatialdds-resolver").json()
    assert set(resolver) == {"authority", "https_base", "cache_ttl_sec"}
    (manifest,) = _search(asked, geohash="u15")
    del manifest["stamp"]
    assert manifest["id"].split("/")[2] == resolver["authority"]
    found = asked.get(resolver["https_base"], params={"uri": manifest["id"]})
    assert found.json() | manifest == found.json()
    assert found.headers["etag"]
    wrong = {
        "https://earth": 400,
        manifest["id"] + "x": 404,
        "spatialdds://a.b/maps/service/c": 404,
    }
    for uri, status in wrong.items():
        assert asked.get(resolver["https_base"], params={"uri": uri}).status_code == status


def test_without_a_domain_of_dds_there_is_no_bootstrap_manifest(asked: httpx.Client):
    refused = asked.get("/.well-known/spatialdds")
    assert refused.status_code == 404
    assert SEARCH in refused.json()["error"]


def test_discovery_takes_the_token_and_pages_of_allowed_origins(
    asked: httpx.Client, open_service: Running
):
    with open_service.client() as stranger:
        assert stranger.post(SEARCH, json={"geohash": "u15"}).status_code == 401
    other = {"origin": "https://elsewhere.example"}
    assert asked.get(SEARCH, params={"geohash": "u15"}, headers=other).status_code == 403


def test_maps_without_a_place_and_damaged_ones_are_left_out(client: httpx.Client):
    results = _search(client, coverage=[{"global": True}])
    assert {one["service"]["service_id"] for one in results} == {"earth"}


def test_results_come_in_pages(maps: Path, tmp_path: Path):
    for name in ("a", "b b", "c"):
        shutil.copy(maps / "earth.topo", tmp_path / f"{name}.topo")
    with running(tmp_path) as service, service.client() as client:
        query, names = {"geohash": "u15", "max_results": 2}, list[str]()
        for number, token in ((2, "2"), (1, "")):
            page = client.post(SEARCH, json=query).json()
            assert (len(page["results"]), page["next_page_token"]) == (number, token)
            names += [one["service"]["service_id"] for one in page["results"]]
            for one in page["results"]:
                Draft202012Validator(MANIFEST).validate(one)
                url = one["service"]["hints"][0]["value"]
                assert client.get(url).json() == {"status": "running"}
            query["page_token"] = token
    assert names == ["a", "b b", "c"]


def test_cells_of_geohashes():
    west, south, east, north = geohash_box("ezs42")
    assert (west, south, east, north) == pytest.approx(
        (-5.625, 42.58300781, -5.58105469, 42.62695313)
    )
    assert geohash_box("u15")[0] < 4.7 < geohash_box("u15")[2]


@given(
    st.lists(st.tuples(st.floats(-89, 89), st.floats(-60, 60)), min_size=1, max_size=5),
    st.floats(-180, 180),
)
def test_a_box_encloses_its_places_over_the_date_line_too(
    places: list[tuple[float, float]], turn: float
):
    turned = [(lat, (lon + turn + 180.0) % 360.0 - 180.0) for lat, lon in places]
    box = enclose(turned)
    for lat, lon in turned:
        assert boxes_intersect(box, (lon, lat, lon, lat))
    far = (turn + 360.0) % 360.0 - 180.0  # on the other side of the earth
    assert not boxes_intersect(box, (far, -90.0, far, 90.0))


def test_every_name_of_a_map_has_an_identifier_of_its_own():
    names = ["lab", "lab.1", "lab_1", "lab 1", "Läb", "lab_2e_1", "_"]
    places = [Announced(name, 1, (0.0, 0.0, 1.0, 1.0), "/", 0) for name in names]
    found = [parse_resource(one.manifest("maps.example", "")["id"]) for one in places]
    assert [one and one[0] for one in found] == ["maps.example"] * len(names)
    assert len({one and one[1] for one in found}) == len(names)
