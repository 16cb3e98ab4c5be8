"""Provide a second small map and buckets of a local S3 server, for tests of atlases and stores."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from uuid import uuid4

import httpx
import pytest

from topoloc.apps.stores.object_store import open_objects
from topoloc.localization.map_facts.map_building import build_map
from topoloc.mapping.build import BuildConfig
from topoloc.recordings.open import open_sequence


@pytest.fixture(scope="session")
def other_map(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the map of another room, made from half as many pairs."""
    from tiny_world import write_stereo_recording

    folder = tmp_path_factory.mktemp("other")
    recording = write_stereo_recording(folder / "other", seed=1, indices=[0.0, 2.0, 4.0, 6.0])
    build_map(open_sequence(str(recording)), BuildConfig(other_kinds=())).save(
        folder / "other.topo"
    )
    return folder / "other.topo"


@pytest.fixture(scope="session")
def s3_server() -> Iterator[str]:
    """Return the address of a local moto server, which has the API of Amazon S3."""
    for needed in ("obstore", "moto", "flask", "flask_cors"):
        pytest.importorskip(
            needed,
            reason="an S3 server to test on needs: pip install obstore 'moto[s3]' flask flask-cors",
        )
    from moto.server import ThreadedMotoServer  # pyright: ignore[reportMissingImports]

    server = ThreadedMotoServer(ip_address="127.0.0.1", port=0, verbose=False)
    server.start()
    host, port = server.get_host_and_port()
    yield f"http://{host}:{port}"
    server.stop()


@pytest.fixture
def s3_bucket(s3_server: str, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> str:
    """Return a new bucket, `s3://...`. Files read from it are cached in a folder of the test."""
    said = {"AWS_ENDPOINT_URL": s3_server, "AWS_DEFAULT_REGION": "us-east-1"}
    said |= {
        "AWS_ACCESS_KEY_ID": "tests",
        "AWS_SECRET_ACCESS_KEY": "tests",
        "TOPOLOC_CACHE": str(tmp_path / "cache"),
    }
    for name, value in said.items():
        monkeypatch.setenv(name, value)
    open_objects.cache_clear()
    name = f"atlas-{uuid4().hex}"
    httpx.put(f"{s3_server}/{name}").raise_for_status()
    return f"s3://{name}"
