"""Test the service of atlases in object stores: results equal a folder's, and a silent store
blocks no client."""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any
from uuid import uuid4

import pytest
from fastapi.testclient import TestClient

from topoloc.apps.service import query_handler, tile_fetcher
from topoloc.apps.service.application import create_application
from topoloc.apps.service.config import ServiceConfig
from topoloc.apps.service.tile_fetcher import TileFetcher, TilePending
from topoloc.apps.stores.object_store import ObjectStore
from topoloc.atlas.atlas import Atlas
from topoloc.atlas.editing import add_tiles, create_atlas, new_tiles, remove_tiles
from topoloc.atlas.map_cache import MapCache
from topoloc.atlas.store import store_at
from topoloc.errors import AtlasError, MapError, ObjectStoreError
from topoloc.localization.localizer import Localizer


@pytest.fixture(params=["memory", "s3"])
def store(
    request: pytest.FixtureRequest,
    room_map: Path,
    other_map: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> str:
    """Return an atlas of the tiles `room` and `other` in an object store."""
    where = (
        f"{request.getfixturevalue('s3_bucket')}/campus"
        if request.param == "s3"
        else _in_memory(tmp_path, monkeypatch)
    )
    create_atlas(where, new_tiles([str(room_map), str(other_map)]))
    return where


@pytest.fixture
def in_memory(
    room_map: Path, other_map: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> str:
    """Return the same atlas in a store in memory, which a test can control."""
    where = _in_memory(tmp_path, monkeypatch)
    create_atlas(where, new_tiles([str(room_map), str(other_map)]))
    return where


def _in_memory(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> str:
    pytest.importorskip("obstore", reason="the extra cluster is not installed")
    monkeypatch.setenv("TOPOLOC_CACHE", str(tmp_path / "cache"))
    return f"memory:///{uuid4().hex}/campus"


@contextmanager
def _served(
    *sources: object, fetch_s: float = 20.0, max_bytes: int = 100_000_000
) -> Iterator[tuple[TestClient, MapCache]]:
    """Run a service of these sources with one worker."""
    config = ServiceConfig(workers=1, fetch_s=fetch_s)
    maps = MapCache(
        [str(source) for source in sources], Localizer, max_bytes, TileFetcher(config.fetch_s).path
    )
    with TestClient(create_application(maps, config), base_url="http://127.0.0.1") as client:
        yield client, maps


def _posted(client: TestClient, path: str, queries: Path) -> Any:
    return client.post(
        path,
        files={"image": ("v.png", (queries / "view02.png").read_bytes())},
        data=_camera(queries),
    )


def _camera(queries: Path) -> dict[str, str]:
    return {"camera": (queries / "camera.json").read_text()}


def _asked(client: TestClient, path: str, queries: Path) -> Any:
    answer = _posted(client, path, queries)
    assert answer.status_code == 200, answer.text
    return answer.json()


def _timeless(answer: Any) -> Any:
    """Return the answer without the parts that differ between requests."""
    if isinstance(answer, dict):
        return {
            name: _timeless(value)
            for name, value in answer.items()
            if name not in ("times_ms", "t_ns")
        }
    return [_timeless(one) for one in answer] if isinstance(answer, list) else answer


def _until(holds: Callable[[], bool]) -> None:
    end = time.monotonic() + 20.0
    while not holds():
        assert time.monotonic() < end, "it did not happen within 20 s"
        time.sleep(0.02)


def _file_of(where: str, tile_id: str) -> str:
    atlas = Atlas.open(where)
    return atlas.tile(tile_id).map.name


def test_it_answers_as_the_atlas_in_a_folder(store: str, atlas: Path, queries: Path):
    with _served(store) as (client, maps), _served(atlas) as (plain, _):
        assert (
            client.get("/v1/maps").json()
            == plain.get("/v1/maps").json()
            == {"maps": ["other", "room"]}
        )
        assert maps.num_open == 0
        for path in ("/v1/localize", "/v1/maps/room/localize", "/v1/maps/other/localize"):
            assert _timeless(_asked(client, path, queries)) == _timeless(
                _asked(plain, path, queries)
            )
        before = maps.acquire_map("room")
        _asked(client, "/v1/maps/room/localize", queries)
        assert maps.acquire_map("room") is before  # it is not opened anew at each request


def test_a_stream_is_followed_in_a_tile(store: str, queries: Path):
    with _served(store) as (client, _):
        assert client.post("/v1/maps/nowhere/sessions").status_code == 404
        begun = client.post("/v1/maps/room/sessions", params=_camera(queries))
        assert begun.status_code == 201, begun.text
        assert _asked(
            client, f"/v1/maps/room/sessions/{begun.json()['session']}/pictures", queries
        )["localized"]


def test_tiles_are_closed_beyond_the_budget(in_memory: str, queries: Path):
    with _served(in_memory, max_bytes=1) as (client, maps):
        for name in ("room", "other", "room"):
            _asked(client, f"/v1/maps/{name}/localize", queries)
            assert maps.num_open == 1


def test_changes_of_the_store_are_noticed(
    store: str, room_map: Path, queries: Path, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr(query_handler, "POLL_INTERVAL_S", 0.1)
    with _served(store) as (client, maps):
        assert _asked(client, "/v1/localize", queries)["map"] == "room"
        remove_tiles(store, ["room"])
        _until(lambda: maps.names() == ["other"])
        assert _asked(client, "/v1/localize", queries)["localized"] is False
        add_tiles(store, new_tiles([str(room_map)], "hall"))
        _until(lambda: client.get("/v1/maps").json() == {"maps": ["hall", "other"]})
        assert _asked(client, "/v1/localize", queries)["map"] == "hall"


def test_polling_does_not_read_a_known_manifest(in_memory: str, monkeypatch: pytest.MonkeyPatch):
    maps, read = MapCache([in_memory], Localizer, 1), list[str]()
    get = type(ObjectStore(in_memory)._objects).get
    monkeypatch.setattr(
        type(ObjectStore(in_memory)._objects),
        "get",
        lambda self, path: read.append(path) or get(self, path),
    )
    assert not maps.atlases[0].look()
    assert read == []
    remove_tiles(in_memory, ["other"])
    read.clear()
    assert maps.atlases[0].look()
    assert [Path(path).suffix for path in read] == [".json"]
    assert maps.names() == ["room"]


@pytest.fixture
def silent_tiles(in_memory: str, monkeypatch: pytest.MonkeyPatch) -> Iterator[threading.Event]:
    """Delay the maps of the store in memory until the event is set."""
    speaks, kind = threading.Event(), type(ObjectStore(in_memory)._objects)
    get = kind.get

    def late(self: Any, name: str) -> Any:
        if name.endswith(".topo"):
            speaks.wait(60.0)
        return get(self, name)

    monkeypatch.setattr(kind, "get", late)
    yield speaks
    speaks.set()


def test_a_silent_store_blocks_no_other_client(
    in_memory: str, silent_tiles: threading.Event, room_map: Path, tmp_path: Path, queries: Path
):
    lone = tmp_path / "lone.topo"
    lone.write_bytes(room_map.read_bytes())
    with _served(in_memory, lone, fetch_s=5.0) as (client, _):
        late, path = list[Any](), "/v1/maps/room/localize"
        asking = threading.Thread(target=lambda: late.append(_posted(client, path, queries)))
        asking.start()
        assert client.get("/v1/maps").json() == {"maps": ["lone", "other", "room"]}
        assert _asked(client, "/v1/maps/lone/localize", queries)["localized"]  # by the only worker
        assert asking.is_alive()
        asking.join(20.0)
        assert (late[0].status_code, late[0].headers["retry-after"]) == (503, "5")
        assert "has not given tile room within 5 s" in late[0].json()["error"]
        assert set(late[0].json()) == {"error", "request_id"}
        for refused in (path, "/v1/localize"):  # by now without waiting
            assert _posted(client, refused, queries).status_code == 503
        silent_tiles.set()
        _until(lambda: _posted(client, path, queries).status_code == 200)
        assert {answer["map"] for answer in _asked(client, "/v1/localize", queries)["answers"]} == {
            "lone",
            "room",
        }


def test_a_tile_that_comes_late_is_waited_for(
    in_memory: str, silent_tiles: threading.Event, queries: Path
):
    with _served(in_memory) as (client, _):
        threading.Timer(1.0, silent_tiles.set).start()
        start = time.monotonic()
        assert _asked(client, "/v1/localize", queries)["map"] == "room"
        assert time.monotonic() - start >= 0.9


def test_open_tiles_localize_while_the_store_is_gone(
    in_memory: str, queries: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
):
    monkeypatch.setattr(query_handler, "POLL_INTERVAL_S", 0.02)
    monkeypatch.setattr(tile_fetcher, "RETRY_AFTER_S", 0.2)

    def gone(*args: object, **more: object) -> None:
        raise OSError("the network is unreachable")

    with _served(in_memory) as (client, _):
        assert _asked(client, "/v1/maps/room/localize", queries)["localized"]
        with (
            monkeypatch.context() as patched,
            caplog.at_level(logging.WARNING, "topoloc.apps.service"),
        ):
            for name in ("list", "get"):
                patched.setattr(type(ObjectStore(in_memory)._objects), name, gone)
            _until(lambda: bool(caplog.records))
            time.sleep(0.2)
            assert [record.getMessage() for record in caplog.records] == [
                "atlas"
            ]  # once, and not at each look
            assert _asked(client, "/v1/maps/room/localize", queries)["localized"]
            answer = _posted(client, "/v1/maps/other/localize", queries)
            assert (answer.status_code, "network is unreachable" in answer.json()["error"]) == (
                503,
                True,
            )
        _until(lambda: _posted(client, "/v1/maps/other/localize", queries).status_code == 200)


@pytest.mark.parametrize(
    ("is_there", "said"), [(False, "is missing"), (True, "its checksum is another")]
)
def test_a_missing_or_rotten_tile_is_named_and_the_others_answer(
    in_memory: str, is_there: bool, said: str, queries: Path, caplog: pytest.LogCaptureFixture
):
    objects, name = ObjectStore(in_memory)._objects, _file_of(in_memory, "other")
    objects.put(name, b"rotten") if is_there else objects.delete(name)
    with (
        _served(in_memory) as (client, _),
        caplog.at_level(logging.WARNING, "topoloc.apps.service"),
    ):
        for _ in range(2):
            answer = _posted(client, "/v1/maps/other/localize", queries)
            assert answer.status_code == 503
            assert name in answer.json()["error"]
            assert said in answer.json()["error"]
        assert _asked(client, "/v1/localize", queries)["map"] == "room"


def test_a_tile_is_fetched_once_for_all_clients(in_memory: str, silent_tiles: threading.Event):
    atlas, fetches = Atlas.open(in_memory), TileFetcher(30.0)
    awaited = list[TilePending]()
    for _ in range(3):
        with pytest.raises(TilePending) as raised:
            fetches.path(atlas, atlas.tile("room"))
        awaited.append(raised.value)
    assert len({id(one.fetch) for one in awaited}) == 1
    silent_tiles.set()
    path = awaited[0].fetch.future.result(20.0)
    assert isinstance(path, Path)
    assert fetches.path(atlas, atlas.tile("room")) == path


def test_the_number_of_parallel_fetches_is_limited(
    in_memory: str, silent_tiles: threading.Event, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr(tile_fetcher, "_MAX_CONCURRENT_FETCHES", 1)
    atlas, fetches = Atlas.open(in_memory), TileFetcher(30.0)
    with pytest.raises(TilePending):
        fetches.path(atlas, atlas.tile("room"))
    with pytest.raises(
        ObjectStoreError, match=r"tile other is not here yet, and 1 others are being fetched"
    ):
        fetches.path(atlas, atlas.tile("other"))


def test_invalid_sources_are_not_served(
    in_memory: str, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
):
    for where, said in (
        (f"{in_memory}/else", "is no atlas"),
        ("nostore://campus", "nostore"),
        (str(tmp_path / "no.topo"), "no such map"),
    ):
        with pytest.raises(MapError, match=said):
            MapCache([where], Localizer, 1)
    monkeypatch.setattr(type(ObjectStore(in_memory)._objects), "list", lambda *_, **__: 1 / 0)
    with pytest.raises(ObjectStoreError, match="does not answer"):
        MapCache([in_memory], Localizer, 1)


def test_a_read_only_cache_folder_is_an_error(
    in_memory: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    (tmp_path / "file").write_text("no folder")
    monkeypatch.setenv("TOPOLOC_CACHE", str(tmp_path / "file"))
    atlas = Atlas.open(in_memory)
    with pytest.raises(ObjectStoreError, match="cannot keep"):
        atlas.map_path(atlas.tile("room"))
    assert isinstance(store_at(in_memory), ObjectStore)
    with pytest.raises(AtlasError, match="cannot keep"):
        _ = atlas.index
