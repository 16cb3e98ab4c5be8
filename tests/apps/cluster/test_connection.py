"""Test cluster addresses: which are valid, and the errors of the others. No cluster is started."""

from __future__ import annotations

import os
import socket
import sys
import tempfile
from collections.abc import Callable
from functools import cache
from pathlib import Path

import pytest

from topoloc.apps.cluster.connection import _create_token, _silence_stderr, connect_to_cluster
from topoloc.errors import ClusterError, MissingExtraError
from topoloc.recordings.atomic import temporary_folder

Complaint = Callable[..., str]
needs_ray = pytest.mark.usefixtures("ray")


@pytest.fixture(scope="module")
def ray():
    return pytest.importorskip("ray", reason="Ray is not installed (the extra cluster)")


@needs_ray
@pytest.mark.parametrize(
    ("address", "says"),
    [
        ("somewhere", "HOST:PORT, auto or local"),
        ("127.0.0.1:", "HOST:PORT, auto or local"),
        ("127.0.0.1:99999", "HOST:PORT, auto or local"),
        ("ray://127.0.0.1:10001", "Ray clients are not supported"),
    ],
)
def test_invalid_addresses_are_refused(
    address: str, says: str, tiny_recording: Path, tmp_path: Path, complaint: Complaint
):
    assert says in complaint("build", tiny_recording, tmp_path / "campus", "--ray", address)


@needs_ray
def test_an_address_without_a_cluster_is_refused(
    tiny_recording: Path, tmp_path: Path, complaint: Complaint, monkeypatch: pytest.MonkeyPatch
):
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
    assert f"no Ray cluster answers at 127.0.0.1:{port}" in complaint(
        "build", tiny_recording, tmp_path / "campus", "--ray", f"127.0.0.1:{port}"
    )
    monkeypatch.delenv("RAY_ADDRESS", raising=False)
    monkeypatch.setattr("ray._private.services.find_gcs_addresses", cache(set))
    monkeypatch.setattr("ray._private.utils.read_ray_address", lambda *_: None)
    with (
        pytest.raises(ClusterError, match="no Ray cluster runs on this machine"),
        connect_to_cluster("auto"),
    ):
        pass


def test_without_ray_the_extra_is_named(
    tiny_recording: Path, tmp_path: Path, complaint: Complaint, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setitem(sys.modules, "ray", None)
    assert "pip install 'topoloc[cluster]'" in complaint(
        "build", tiny_recording, tmp_path / "campus", "--ray", "auto"
    )
    with pytest.raises(MissingExtraError, match="cluster"), connect_to_cluster("local"):
        pass


def test_folders_of_killed_clusters_are_removed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    (tmp_path / "topoloc-ray-left" / "session").mkdir(parents=True)
    with temporary_folder("topoloc-ray-") as one:
        assert list(tmp_path.iterdir()) == [one]
        with temporary_folder("topoloc-ray-") as two:
            assert sorted(tmp_path.iterdir()) == sorted([one, two])
        assert list(tmp_path.iterdir()) == [one]
    assert list(tmp_path.iterdir()) == []


def test_a_cluster_of_our_own_has_a_token_of_its_own(monkeypatch: pytest.MonkeyPatch):
    names = ("RAY_AUTH_MODE", "RAY_AUTH_TOKEN", "RAY_AUTH_TOKEN_PATH")
    for name in names:
        monkeypatch.delenv(name, raising=False)
    tokens = set()
    for _ in range(2):
        with _create_token():
            tokens.add(os.environ["RAY_AUTH_TOKEN"])
            os.environ["RAY_AUTH_MODE"] = "token"  # as Ray does
        assert not set(names) & set(os.environ)
    assert len(tokens) == 2
    monkeypatch.setenv("RAY_AUTH_MODE", "disabled")
    with _create_token():
        assert "RAY_AUTH_TOKEN" not in os.environ
    assert os.environ["RAY_AUTH_MODE"] == "disabled"


def test_output_of_libraries_is_hidden(capfd: pytest.CaptureFixture[str]):
    with _silence_stderr():
        os.write(2, b"a warning of C++")
    os.write(2, b"ours")
    assert capfd.readouterr().err == "ours"


@pytest.mark.parametrize("option", [["--world", "campus"], ["--replace"]])
def test_options_of_a_cluster_alone(
    option: list[str], tiny_recording: Path, tmp_path: Path, complaint: Complaint
):
    assert "need --ray" in complaint(
        "build", tiny_recording, tmp_path / "room.topo", *option, status=2
    )


def test_names_that_no_world_and_no_two_tiles_have(
    tiny_recording: Path, tmp_path: Path, complaint: Complaint
):
    assert "can be called 'the campus'" in complaint(
        "build", tiny_recording, tmp_path / "campus", "--ray", "auto", "--world", "the campus"
    )
    assert "given twice" in complaint(
        "build", tiny_recording, tiny_recording, tmp_path / "campus", "--ray", "auto"
    )


def test_a_forgotten_atlas(
    tiny_recording: Path, room_map: Path, tmp_path: Path, complaint: Complaint
):
    for last in (tiny_recording, f"{tiny_recording}@0:5", room_map):
        assert "was ATLAS forgotten?" in complaint(
            "build", tiny_recording, last, "--ray", "auto", status=2
        )
    assert "last, the atlas" in complaint("build", tiny_recording, "--ray", "auto", status=2)
