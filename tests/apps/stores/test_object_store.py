"""Test stores that answer late, wrongly or never, and the requests to S3."""

from __future__ import annotations

import socket
import time
from collections.abc import Iterator
from pathlib import Path
from uuid import uuid4

import pytest

from topoloc.apps.cli import main
from topoloc.apps.stores import object_store
from topoloc.apps.stores.object_store import ObjectStore
from topoloc.atlas.atlas import Atlas
from topoloc.atlas.editing import add_tiles, create_atlas, new_tiles, remove_tiles
from topoloc.errors import AtlasError
from topoloc.localization.localizer import Localizer
from topoloc.localization.result import Localization


@pytest.fixture
def silent(monkeypatch: pytest.MonkeyPatch) -> Iterator[str]:
    """Return the address of a store that accepts connections and never answers."""
    pytest.importorskip("obstore", reason="the extra cluster is not installed")
    listener = socket.create_server(("127.0.0.1", 0), backlog=64)
    monkeypatch.setenv("AWS_ENDPOINT_URL", f"http://127.0.0.1:{listener.getsockname()[1]}")
    for name in ("AWS_ACCESS_KEY_ID", "AWS_SECRET_ACCESS_KEY", "AWS_DEFAULT_REGION"):
        monkeypatch.setenv(name, "us-east-1")
    for name in ("connect_timeout", "read_timeout"):
        monkeypatch.setitem(object_store.CLIENT, name, "300ms")
    object_store.open_objects.cache_clear()
    yield "s3://campus/atlas"
    listener.close()


def test_a_silent_store_times_out(silent: str, room_map: Path, capsys: pytest.CaptureFixture[str]):
    start = time.monotonic()
    for args in (["info", silent], ["add", silent, str(room_map)]):
        assert main(["atlas", *args]) == 1
        said = capsys.readouterr().err
        assert said.count("\n") == 1
        assert "does not answer" in said
    assert time.monotonic() - start < 15.0  # two tries of 0.3 s each, and their pauses


def test_waiting_for_s3_ends_within_a_minute_or_so():
    one = sum(
        int(str(object_store.CLIENT[name]).removesuffix("s"))
        for name in ("connect_timeout", "read_timeout")
    )
    assert (1 + object_store.RETRIES["max_retries"]) * one <= 90


def test_pictures_are_localized_in_an_atlas_on_s3(s3_bucket: str, room_map: Path, other_map: Path):
    from built_room import unseen_views
    from tiny_world import CAMERA

    where = f"{s3_bucket}/deep/campus"
    create_atlas(where, new_tiles([str(room_map), str(other_map)]))
    localizer = Localizer(Atlas.open(where))
    for seed, tile in ((0, "room"), (1, "other")):
        result = localizer.localize(unseen_views(seed)[1][0], CAMERA)
        assert isinstance(result, Localization)
        assert result.provenance.tile == tile


def test_unnamed_files_are_removed_from_s3_after_their_time(
    s3_bucket: str, room_map: Path, other_map: Path
):
    where = f"{s3_bucket}/campus"
    create_atlas(where, new_tiles([str(room_map)]))
    store = ObjectStore(where)
    assert all(-60.0 < age < 60.0 for age in store.ages("tiles").values())
    remove_tiles(where, ["room"])
    assert len(store.ages("tiles")) == 2
    add_tiles(
        where, new_tiles([str(other_map)]), grace_s=-60.0
    )  # the clock of the server may be another
    assert {name.partition("-")[0] for name in store.ages("tiles")} == {"tiles/other"}


def test_of_manifests_of_one_number_the_first_counts(s3_bucket: str):
    first, second = ObjectStore(f"{s3_bucket}/campus"), ObjectStore(f"{s3_bucket}/campus")
    assert first.commit(None, b"1")
    assert not second.commit(None, b"2")
    assert second.commit(b"1", b"2")
    assert first.manifest() == b"2"
    for number in range(3, 30):
        assert first.commit(str(number - 1).encode(), str(number).encode())
    assert second.manifest() == b"29"


def test_files_written_since_the_last_listing_are_found(s3_bucket: str):
    first = ObjectStore(f"{s3_bucket}/campus")
    object_store.open_objects.cache_clear()
    second = ObjectStore(f"{s3_bucket}/campus")
    assert first.commit(None, b"1")
    assert second.manifest() == b"1"
    assert first.commit(b"1", b"2")
    assert not second._create_object("manifests/000000002.json", b"3")
    assert second.commit(b"2", b"3")


def test_a_manifest_that_is_removed_while_it_is_read_is_sought_again(
    s3_bucket: str, monkeypatch: pytest.MonkeyPatch
):
    store = ObjectStore(f"{s3_bucket}/campus")
    assert store.commit(None, b"1")
    assert store.commit(b"1", b"2")
    listed = store._manifests

    def late() -> list[str]:
        monkeypatch.setattr(store, "_manifests", listed)
        return [*listed()[:-1], "manifests/000000000.json"]

    monkeypatch.setattr(store, "_manifests", late)
    assert store.manifest() == b"2"


def test_a_write_conflict_is_retried_and_other_failures_are_raised(
    monkeypatch: pytest.MonkeyPatch,
):
    pytest.importorskip("obstore", reason="the extra cluster is not installed")
    from obstore.exceptions import AlreadyExistsError

    store = ObjectStore(f"memory:///{uuid4().hex}/campus")
    errors = [AlreadyExistsError("another writer"), OSError("no space")]

    def refused(*args: object, **kwargs: object) -> None:
        raise errors.pop(0)

    monkeypatch.setattr(type(store._objects), "put", refused)
    assert not store.commit(None, b"1")
    with pytest.raises(AtlasError, match="no space"):
        store.commit(None, b"1")


def test_an_answer_that_was_lost_is_no_other_writer(
    s3_bucket: str, monkeypatch: pytest.MonkeyPatch
):
    """The client repeats a write that succeeded. The object exists and is its own."""
    store = ObjectStore(f"{s3_bucket}/campus")
    put = type(store._objects).put

    def twice(self: object, name: str, data: bytes, mode: str = "overwrite") -> None:
        put(self, name, data, mode=mode)
        put(self, name, data, mode=mode)

    monkeypatch.setattr(type(store._objects), "put", twice)
    assert store.commit(None, b"1")
    assert store.manifest() == b"1"


def test_a_missing_bucket_is_named(s3_bucket: str, room_map: Path):
    with pytest.raises(AtlasError, match="404 Not Found"):
        Atlas.open(f"{s3_bucket}-not/campus")
    with pytest.raises(AtlasError, match="does not answer, or not as a store"):
        create_atlas(f"{s3_bucket}-not/campus", new_tiles([str(room_map)]))
