"""Connect this process to a Ray cluster, or start a temporary one on this machine.

Ray is the extra `cluster`. It is imported inside functions only.
"""

from __future__ import annotations

import contextlib
import os
import secrets
import signal
import socket
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from topoloc import ClusterError, MissingExtraError
from topoloc.apps.core_names import temporary_folder

LOCAL, AUTO = "local", "auto"
_CONNECT_TIMEOUT_S = 5.0
_TEMP_PREFIX = "topoloc-ray-"  # short, for sockets lie in it
_CONNECTED: list[str] = []
_NETWORK_VARIABLE = "RAY_ENABLE_WINDOWS_OR_OSX_CLUSTER"
_TOKEN_VARIABLES = ("RAY_AUTH_MODE", "RAY_AUTH_TOKEN", "RAY_AUTH_TOKEN_PATH")


def import_ray() -> Any:
    """Import Ray. Raises MissingExtraError."""
    with MissingExtraError.on_import("a cluster needs {}", "cluster"):
        import ray

        return ray


@contextmanager
def connect_to_cluster(address: str) -> Iterator[Any]:
    """Connect to a cluster and return Ray. Running tasks are cancelled when the block ends.

    A nested block with the same address uses the same connection. Raises MissingExtraError: Ray is
    not installed; ClusterError: no Ray cluster of this version answers.

    Args:
        address: HOST:PORT; `auto` for the cluster of this machine or of RAY_ADDRESS; `local` for a
            temporary one of this machine's processors.
    """
    ray = import_ray()
    if address in _CONNECTED:
        yield ray
        return
    _check_address(address)
    with contextlib.ExitStack() as at_end:
        options: dict[str, Any] = {"address": address}
        if address == LOCAL:
            os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
            at_end.enter_context(_create_token())
            at_end.enter_context(_on_this_machine_only(ray))
            options |= {
                "include_dashboard": False,
                "_temp_dir": str(at_end.enter_context(temporary_folder(_TEMP_PREFIX))),
            }
        before = signal.getsignal(signal.SIGTERM)
        try:
            with _silence_stderr():
                ray.init(**options, log_to_driver=False, logging_level="error")
        except Exception as error:  # of many classes, which are no API
            ray.shutdown()
            raise ClusterError(_failure_reason(address, error)) from error
        at_end.callback(ray.shutdown)
        # Ray's own handler prints a stack trace
        if threading.current_thread() is threading.main_thread():
            signal.signal(signal.SIGTERM, _raise_interrupt)
            at_end.callback(signal.signal, signal.SIGTERM, before or signal.SIG_DFL)
        _CONNECTED.append(address)
        at_end.callback(_CONNECTED.remove, address)
        yield ray


def _raise_interrupt(number: int, _: object) -> None:
    """Handle SIGTERM like Ctrl-C."""
    raise KeyboardInterrupt


def _check_address(address: str) -> None:
    """Check an address. Ray itself would try for a minute and print long messages."""
    if address in (LOCAL, AUTO):
        return
    if "://" in address:
        raise ClusterError(
            f"--ray {address}: Ray clients are not supported; run the command on a machine of the"
            " cluster, with HOST:PORT or auto"
        )
    host, colon, port = address.rpartition(":")
    if not colon or not host or not port.isdecimal() or not 0 < int(port) < 65536:
        raise ClusterError(f"--ray {address[:80]}: use HOST:PORT, auto or local")
    try:
        socket.create_connection((host.strip("[]"), int(port)), _CONNECT_TIMEOUT_S).close()
    except (OSError, UnicodeError) as error:
        raise ClusterError(
            f"no Ray cluster answers at {address}: {getattr(error, 'strerror', None) or error}"
        ) from None


def _failure_reason(address: str, error: Exception) -> str:
    text = " ".join(str(error).split())
    if "ersion mismatch" in text:
        versions = text.partition("mismatch")[2].strip(" :!.")[:300]
        return f"the Ray cluster at {address} has another version: {versions}"
    if "Could not find any running Ray instance" in text:
        start = "start one with `ray start --head`, or use --ray local"
        return f"no Ray cluster runs on this machine; {start}"
    reason = f"no Ray cluster answers at {address}: {text[:300] or type(error).__name__}"
    if "RAY_AUTH_MODE" in os.environ:
        return reason
    return f"{reason}; a cluster with a token needs RAY_AUTH_MODE=token and the token"


@contextmanager
def _silence_stderr() -> Iterator[None]:
    """Drop the messages of Ray's C++ part. The Python error that follows contains the reason."""
    try:
        kept = os.dup(2)
    except OSError:  # closed by the caller
        yield
        return
    nowhere = os.open(os.devnull, os.O_WRONLY)
    try:
        sys.stderr.flush()
        os.dup2(nowhere, 2)
        yield
    finally:
        os.dup2(kept, 2)
        os.close(kept)
        os.close(nowhere)


@contextmanager
def _on_this_machine_only(ray: Any) -> Iterator[None]:
    """Let a temporary cluster use 127.0.0.1 alone, and no process of the dashboard.

    With `include_dashboard=False` this process only prepares reports of usage. Even if these are
    off, it connects to the metadata services of clouds. The variable is Ray's switch for clusters
    of one machine, and its constant is the value that this process has read at import.
    """
    constants, node = ray._private.ray_constants, ray._private.node.Node
    before = constants.ENABLE_RAY_CLUSTER, node.start_api_server
    is_unset = _NETWORK_VARIABLE not in os.environ
    if is_unset:
        os.environ[_NETWORK_VARIABLE], constants.ENABLE_RAY_CLUSTER = "0", False
    node.start_api_server = lambda *_, **__: None
    try:
        yield
    finally:
        constants.ENABLE_RAY_CLUSTER, node.start_api_server = before
        if is_unset:
            os.environ.pop(_NETWORK_VARIABLE, None)


@contextmanager
def _create_token() -> Iterator[None]:
    """Protect a temporary cluster with a token. Otherwise Ray would store one in the user's home,
    which later clusters require."""
    if any(name in os.environ for name in _TOKEN_VARIABLES):
        yield
        return
    os.environ["RAY_AUTH_TOKEN"] = secrets.token_hex(32)
    try:
        yield
    finally:  # Ray has set the mode
        for name in _TOKEN_VARIABLES:
            os.environ.pop(name, None)
