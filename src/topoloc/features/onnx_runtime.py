"""Load ONNX Runtime with its telemetry switched off.

Since 1.29 its wheels store an identifier of the device and a database of events in the user's cache
folder and send the events. Variables of the environment switch this off, if they are set before the
import. `onnxruntime.disable_telemetry_events` is too late for the identifier and the database.
"""

from __future__ import annotations

import logging
import os
import sys
import threading
from typing import Any, Literal

VARIABLES = ("ORT_DISABLE_TELEMETRY", "ORT_TELEMETRY_DISABLED")
"""The names of the switch in all versions."""
_OFF = ("1", "on", "true", "yes")
_LOGGER = logging.getLogger(__name__)
_lock = threading.Lock()
_was_imported: list[bool] = []


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
    is_off = os.environ[VARIABLES[0]].lower() in _OFF
    return "off" if is_off else "on by the environment"


def _switch_off() -> bool:
    """Set the variables, if the user has set none, at the first call. Return whether ONNX Runtime
    had been imported before without them."""
    with _lock:
        if not _was_imported:
            values = [os.environ[name] for name in VARIABLES if name in os.environ]
            for name in VARIABLES:
                os.environ.setdefault(name, (values or ["1"])[0])
            _was_imported.append(not values and "onnxruntime" in sys.modules)
            if _was_imported[0]:
                _LOGGER.warning(
                    "ONNX Runtime was imported before topoloc, and its telemetry is on; set"
                    " %s=1 before the import",
                    VARIABLES[0],
                )
        return _was_imported[0]
