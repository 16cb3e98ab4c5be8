"""topoloc doctor: report the installation and test it."""

from __future__ import annotations

import hashlib
import os
import platform
import re
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from importlib import metadata
from pathlib import Path
from typing import Any

from packaging.requirements import Requirement

import topoloc
from topoloc import plugin
from topoloc.apps import core_names
from topoloc.apps.cli import PLUGIN_PACKAGES
from topoloc.apps.cli.output import (
    File,
    check_outputs,
    interruptible,
    print_fields,
    print_line,
    write_json,
)

_REINSTALL = "reinstall: pip install --force-reinstall topoloc"
Found = tuple[dict[str, Any], list[str]]
"""The facts of one part of the report, and its faults, each with a remedy."""


@dataclass(frozen=True)
class Command:
    """Arguments of `topoloc doctor`."""

    json: File = None
    """Write the report as JSON to this file (- for standard output)."""

    def run(self) -> int:
        check_outputs([self.json])
        facts, faults = dict[str, Any](), list[str]()
        for name, examine in _PARTS.items():
            try:
                with interruptible():
                    facts[name], found = examine()
            except Exception as error:  # a broken library may raise any exception
                reason = " ".join(f"{type(error).__name__}: {error}".split())
                facts[name], found = {}, [f"{name}: {reason}; {_REINSTALL}"]
            faults += found
        write_json(self.json, facts | {"faults": faults})
        if self.json != "-":
            print_fields([*_describe(facts), ("faults", str(len(faults) or "none"))])
        for fault in faults:
            print_line(f"error: {fault}", sys.stderr)
        return 1 if faults else 0


def _examine_versions() -> Found:
    """Return the versions of Python and of the libraries that topoloc cannot do without."""
    facts = {"topoloc": _version_of("topoloc"), "python": platform.python_version()}
    facts["platform"] = platform.platform()
    facts |= {name: found for name in PLUGIN_PACKAGES.values() if (found := _version_of(name))}
    needed = [one for extra, one in _requirements() if not extra]
    libraries = {one.name: _version_of(one.name) for one in needed}
    faults = [
        f"{one.name} {libraries[one.name] or 'is missing'}; pip install '{one.name}{one.specifier}'"
        for one in needed
        if not _is_installed(one)
    ]
    if not needed:
        faults.append("topoloc is not installed: pip install topoloc")
    return facts | {"libraries": libraries}, faults


def _examine_processor() -> Found:
    """Return the processor, and how many of its cores this process may use."""
    model, usable = platform.processor(), os.cpu_count()
    cpuinfo = Path("/proc/cpuinfo")
    if cpuinfo.is_file():  # Linux
        lines = re.search(r"^model name\s*: (.*)", cpuinfo.read_text(encoding="utf-8"), re.M)
        model = lines[1] if lines else model
    if hasattr(os, "sched_getaffinity"):  # neither macOS nor Windows
        usable = len(os.sched_getaffinity(0))
    facts = {"model": model or platform.machine(), "architecture": platform.machine()}
    return facts | {"processors": os.cpu_count(), "usable": usable}, []


def _examine_extras() -> Found:
    """Return the extras, and the missing libraries of each. None: this platform has none."""
    facts: dict[str, Any] = {one: None for one in _extras() if one not in ("all", "docs", "test")}
    for extra, library in _requirements():
        if extra in facts:
            one = facts[extra] = facts[extra] or {"missing": [], "install": None}
            if not _is_installed(library):
                one["missing"].append(library.name)
                one["install"] = f"pip install 'topoloc[{extra}]'"
    return facts, []


def _examine_caches() -> Found:
    """Return the folders of fetched networks and of compiled code."""
    networks, *kernels = plugin.cache_folder(), *core_names.kernel_caches()
    facts = {
        "networks": [_describe_folder(networks, "*")],
        "kernels": [_describe_folder(folder, "**/*.nb?") for folder in kernels],
    }
    if any(one["writable"] or one["bytes"] for one in facts["kernels"]):
        return facts, []
    text = f"{' or '.join(map(str, kernels))} cannot be written; NUMBA_CACHE_DIR names another"
    return facts, [f"every process compiles for a minute: {text} folder"]


def _examine_telemetry() -> Found:
    """Return whether libraries send data about their use."""
    state = core_names.find_telemetry()
    remedy = "set ORT_DISABLE_TELEMETRY=1 before that import"
    text = f"onnxruntime was imported before topoloc, and its telemetry is on; {remedy}"
    return {"onnxruntime": state}, [text] if state == "on by an earlier import" else []


def _examine_networks() -> Found:
    """Run each network that is here on a small picture."""
    facts, faults = dict[str, Any](), list[str]()
    for network in core_names.NetworkInfo.known():
        try:
            path = network.find_file()
        except topoloc.WeightsError as missing:
            facts[network.name] = None
            faults += [] if network.file else [f"{missing}; {_REINSTALL}"]
            continue
        with path.open("rb") as file:
            digest = hashlib.file_digest(file, "sha256").hexdigest()
        facts[network.name] = {"path": str(path), "sha256": digest}
        try:
            core_names.NetworkInfo.of_file(path)
        except topoloc.WeightsError as error:
            remedy = f"remove it; {network.install_hint}" if network.file else _REINSTALL
            faults.append(f"{error}; {remedy}")
    return facts, faults


def _examine_pipeline() -> Found:
    """Map a piece of the demo's room, and localize an image of another walk in the saved map."""
    from topoloc.demo.recordings import SHIPPED

    wait = "compiling, once: about a minute ..."
    topoloc.warm_up(only_if_cold=lambda: print_line(wait, sys.stderr))
    start = time.perf_counter()
    with core_names.temporary_folder("topoloc-doctor-") as folder:
        recording = topoloc.open_sequence(f"{SHIPPED / 'map_lap1'}@0:6")
        topoloc.build_map(recording).save(folder / "room.topo")
        with topoloc.TopoMetricMap.load(folder / "room.topo") as topomap:
            walk = topoloc.open_sequence(SHIPPED / "day")
            (answer,) = topoloc.localize_queries(topoloc.Localizer(topomap), walk, frames=[0])
    is_localized = isinstance(answer.result, topoloc.Localization)
    facts = {
        "images_mapped": len(recording),
        "localized": is_localized,
        "translation_m": answer.translation_m if is_localized else None,
        "rotation_deg": answer.rotation_deg if is_localized else None,
        "seconds": round(time.perf_counter() - start, 2),
    }
    if answer.translation_m < 0.05 and answer.rotation_deg < 1.0:
        return facts, []
    wrong = f"a pose is {100 * answer.translation_m:.1f} cm, {answer.rotation_deg:.1f} degrees off"
    wrong = wrong if is_localized else "an image of the mapped room is not localized"
    return facts, [f"self-test: {wrong}; {_REINSTALL}"]


_PARTS: dict[str, Callable[[], Found]] = {
    "versions": _examine_versions,
    "processor": _examine_processor,
    "extras": _examine_extras,
    "caches": _examine_caches,
    "telemetry": _examine_telemetry,
    "networks": _examine_networks,
    "self_test": _examine_pipeline,
}


def _describe(facts: dict[str, Any]) -> Iterator[tuple[str, str]]:
    """Yield the lines of the printed text. A part that failed is empty."""
    for name, version in facts["versions"].items():
        if name == "libraries":
            version = ", ".join(f"{one} {found or 'missing'}" for one, found in version.items())
        yield name, version or "missing"
    if one := facts["processor"]:
        yield "processor", f"{one['model']}: {one['processors']} cores, {one['usable']} usable"
    for name, one in facts["extras"].items():
        text = "installed" if one else "has no package for this platform"
        if one and one["missing"]:
            text = f"{', '.join(one['missing'])} missing: {one['install']}"
        yield f"extra {name}", text
    for name, folders in facts["caches"].items():
        for one in folders:
            access = "writable" if one["writable"] else "read-only"
            yield f"cache of {name}", f"{one['path']}, {one['bytes'] / 1e6:.1f} MB, {access}"
    for name, state in facts["telemetry"].items():
        yield f"telemetry of {name}", state
    for name, one in facts["networks"].items():
        if one:
            yield f"network {name}", f"{one['path']}, SHA-256 {one['sha256'][:12]}..."
    if missing := [name for name, one in facts["networks"].items() if not one]:
        yield "other networks", f"{', '.join(missing)}: see `topoloc weights list`"
    if (one := facts["self_test"]) and one["localized"]:
        errors = f"{100 * one['translation_m']:.2f} cm, {one['rotation_deg']:.2f} degrees"
        text = f"an image localized in a map of {one['images_mapped']}, {errors} off"
        yield "self-test", f"{text}; {one['seconds']:.1f} s"


def _requirements() -> Iterator[tuple[str, Requirement]]:
    """Yield the extra, empty for the program itself, and each library that topoloc may use on this
    platform."""
    for one in map(Requirement, (metadata.requires("topoloc") or []) if _extras() else []):
        for extra in ("", *_extras()):
            if one.marker is None or one.marker.evaluate({"extra": extra}):
                yield extra, one
                if not extra:
                    break


def _extras() -> list[str]:
    """Return the names of all extras, none if topoloc is not installed."""
    try:
        return metadata.metadata("topoloc").get_all("Provides-Extra", [])
    except metadata.PackageNotFoundError:
        return []


def _version_of(name: str) -> str | None:
    try:
        return metadata.version(name)
    except metadata.PackageNotFoundError:
        return None


def _is_installed(library: Requirement) -> bool:
    found = _version_of(library.name)
    return found is not None and library.specifier.contains(found, prereleases=True)


def _describe_folder(folder: Path, pattern: str) -> dict[str, Any]:
    there = next(one for one in (folder, *folder.parents) if one.exists())
    return {
        "path": str(folder),
        "bytes": sum(one.stat().st_size for one in folder.glob(pattern) if one.is_file()),
        "writable": there.is_dir() and os.access(there, os.W_OK),
    }
