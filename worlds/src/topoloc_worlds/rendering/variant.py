"""Choose the variant of Mitsuba: vectorised by LLVM if a usable libLLVM is found, else one ray at a
time.

Mitsuba compiles its kernels with any libLLVM that it finds. An unsuitable one (LLVM 15, for
example) aborts the whole process in code generation. So every library is first tested in a child
process, and the result is stored.
"""

from __future__ import annotations

import contextlib
import glob
import json
import os
import re
import subprocess
import sys
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

from topoloc.errors import MissingExtraError, TopolocError

LLVM, SCALAR = "llvm_ad_rgb", "scalar_rgb"
_FORCE, _LIBRARY = "TOPOLOC_MITSUBA_VARIANT", "DRJIT_LIBLLVM_PATH"
_KERNELS = "DRJIT_CACHE_DIR"
_PLACES = (
    "/usr/lib/*-linux-gnu/libLLVM*",
    "/usr/lib/llvm-*/lib/libLLVM*",
    "/usr/lib64/libLLVM*",
    "/usr/lib/libLLVM*",
    "/usr/local/lib/libLLVM*",
    "/opt/homebrew/opt/llvm*/lib/libLLVM*",
    "/usr/local/opt/llvm*/lib/libLLVM*",
)
_OLDEST = 16
_PROBE = """
import mitsuba as mi
mi.set_variant('llvm_ad_rgb')
import numpy as np
texture = {'type': 'bitmap', 'data': mi.TensorXf(np.linspace(0, 1, 48, dtype=np.float32).reshape(4, 4, 3)), 'raw': True}
scene = mi.load_dict({
    'type': 'scene', 'integrator': {'type': 'path', 'max_depth': 3},
    'sky': {'type': 'constant'},
    'ball': {'type': 'sphere', 'bsdf': {'type': 'twosided', 'b': {'type': 'roughplastic', 'diffuse_reflectance': texture}}},
    'sensor': {'type': 'perspective', 'to_world': mi.ScalarTransform4f().look_at([0, 0, 4], [0, 0, 0], [0, 1, 0]),
               'film': {'type': 'hdrfilm', 'width': 8, 'height': 8}},
})
raise SystemExit(0 if np.asarray(mi.render(scene, spp=4)).max() > 0 else 1)
"""  # noqa: E501


def use_best_variant(force: str | None = None) -> str:
    """Make Mitsuba's fastest usable variant current, and return its name.

    Args:
        force: a variant's name, used without tests. The environment variable
            TOPOLOC_MITSUBA_VARIANT does the same.

    Raises:
        MissingExtraError: Mitsuba is not installed.
        TopolocError: the forced variant is unknown, or needs a libLLVM and none works.
    """
    _keep_kernels()
    try:
        import mitsuba
    except ImportError:
        raise MissingExtraError("rendering needs Mitsuba 3: pip install mitsuba") from None
    current = mitsuba.variant()
    wanted = force or os.environ.get(_FORCE) or None
    if wanted is None and current in (LLVM, SCALAR):
        return current
    if wanted is not None and wanted not in mitsuba.variants():
        raise TopolocError(f"unknown Mitsuba variant {wanted!r}; use {LLVM} or {SCALAR}")
    if wanted is None or wanted.startswith("llvm"):
        library = find_llvm()
        if library is not None:
            os.environ[_LIBRARY] = library
        elif wanted is not None:
            raise TopolocError(
                f"{wanted} needs a libLLVM of version {_OLDEST} or later, and none was found that"
                f" works (set {_LIBRARY})"
            )
        wanted = wanted or (LLVM if library is not None else SCALAR)
    if wanted != current:
        mitsuba.set_variant(wanted)
    return wanted


def find_llvm() -> str | None:
    """Path of the first libLLVM that renders: the one of DRJIT_LIBLLVM_PATH alone if that is set,
    else the newest installed."""
    named = os.environ.get(_LIBRARY)
    verdicts = _read_cache()
    for library in [named] if named else installed_llvms():
        key = _key(library)
        if key is None:
            continue
        if key not in verdicts:
            verdicts[key] = _renders(library)
            _write_cache(verdicts)
        if verdicts[key]:
            return library
    return None


def installed_llvms() -> list[str]:
    """LLVM libraries in the usual places of Linux and macOS, newest first; none older than version
    16, none twice."""
    found: dict[str, tuple[int, str]] = {}
    for pattern in _PLACES:
        for path in sorted(glob.glob(pattern)):
            match = re.search(r"libLLVM(?:-|\.so\.|-C\.so\.)?(\d*)[^/]*\.?(?:so|dylib)?", path)
            of_folder = re.search(r"llvm[-@](\d+)", path)
            number = (match and match[1]) or (of_folder and of_folder[1])
            if (
                number
                and int(number) >= _OLDEST
                and re.search(r"libLLVM[-.\d]*(?:\.so[.\d]*|\.dylib)$", path)
            ):
                found.setdefault(os.path.realpath(path), (int(number), path))
    return [path for _, path in sorted(found.values(), key=lambda entry: -entry[0])]


def _renders(library: str) -> bool:
    """Return whether Mitsuba can render with this library, tested in a process of its own. Its
    error output is dropped."""
    environment = {**os.environ, _LIBRARY: library}
    try:
        child = subprocess.run(
            [sys.executable, "-c", _PROBE],
            env=environment,
            capture_output=True,
            timeout=120,
            check=False,
        )
    except (OSError, subprocess.TimeoutExpired):
        return False
    return child.returncode == 0


def _key(library: str) -> str | None:
    try:
        changed = os.stat(library).st_mtime_ns
        return f"{version('mitsuba')} {os.path.realpath(library)} {changed}"
    except (OSError, PackageNotFoundError):
        return None


def cache_folder() -> Path:
    """Return the folder for files that can be made again.

    Raises:
        RuntimeError: the user has no home folder.
    """
    folder = os.environ.get("XDG_CACHE_HOME")
    return Path(folder or Path.home() / ".cache") / "topoloc"


def _keep_kernels() -> None:
    """Let Dr.Jit keep its compiled kernels in the cache folder, unless DRJIT_CACHE_DIR names
    another; its own default is a folder in the user's home."""
    with contextlib.suppress(OSError, RuntimeError):  # the latter: no home folder
        if not os.environ.get(_KERNELS):
            folder = cache_folder() / "drjit"
            folder.mkdir(parents=True, exist_ok=True)
            os.environ[_KERNELS] = str(folder)


def _cache_file() -> Path:
    return cache_folder() / "llvm.json"


def _read_cache() -> dict[str, bool]:
    try:
        data = json.loads(_cache_file().read_text(encoding="utf-8"))
    except (OSError, ValueError, RuntimeError):  # the last: no home folder
        return {}
    return data if isinstance(data, dict) else {}


def _write_cache(verdicts: dict[str, bool]) -> None:
    try:
        path = _cache_file()
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(json.dumps(verdicts, indent=1), encoding="utf-8")
    except (OSError, RuntimeError):
        return  # it is only a shortcut
