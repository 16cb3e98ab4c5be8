"""Run topoloc as on Linux on ARM (aarch64), emulated: python tools/arm64.py ROOT [--demo FOLDER]
    [--tests PATH ...]

Makes ROOT from Debian's arm64 packages and aarch64 wheels, once. Then runs `topoloc doctor`, the
queries of a folder of `topoloc demo`, and tests, by QEMU. The same queries run on this machine
without PoseLib, which has no package there: poses may differ by a millimetre. Emulated times say
nothing. Needs `apt-get` with Debian's lists (without root), and QEMU 10: version 7.2 of Debian 12
ends in ONNX Runtime, its backports have a newer `qemu-user`; --emulator gives another path.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import tomllib
from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np
from packaging.requirements import Requirement

HERE = Path(__file__).resolve().parents[1]
ARM = {"platform_machine": "aarch64", "sys_platform": "linux", "platform_system": "Linux"}
PYTHON = "3.11"  # Debian 12's
WITHOUT_POSELIB = (
    "import sys; sys.modules['poselib'] = None;from topoloc.apps.cli import main; sys.exit(main())"
)
MAX_DIFFERENCE = 1e-3  # metres
WALKS = ("day", "night", "other_camera")


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("root", type=Path)
    parser.add_argument("--demo", type=Path)
    parser.add_argument("--emulator", default="qemu-aarch64")
    parser.add_argument("--tests", nargs="*", default=[])
    arguments = parser.parse_args()
    root = arguments.root.resolve()
    if not (root / "made").exists():
        add_debian(root)
        add_wheels(root)
        (root / "made").touch()
    run = partial(emulate, root, arguments.emulator)
    failed = run("-m", "topoloc", "doctor")
    if arguments.demo is not None:
        failed |= compare_queries(run, arguments.demo, root)
    if arguments.tests:
        failed |= run("-m", "pytest", "-q", "-p", "no:cacheprovider", *arguments.tests)
    return failed


def emulate(root: Path, emulator: str, *arguments: object) -> int:
    """Run ROOT's Python with these arguments. Return its exit status."""
    # the sources come first; of the installed project only its metadata are read
    parts = (HERE / part / "src" for part in (".", "worlds", "paper", "training"))
    folders = *parts, root / "site"
    variables = {
        "PYTHONPATH": os.pathsep.join(map(str, folders)),
        "PYTHONDONTWRITEBYTECODE": "1",
        "NUMBA_CACHE_DIR": str(root / "kernels"),
        "XDG_CACHE_HOME": str(root / "cache"),
    }
    python = [emulator, "-L", root, root / "usr" / "bin" / f"python{PYTHON}"]
    return subprocess.run([*python, *arguments], env=os.environ | variables).returncode


def add_debian(root: Path) -> None:
    """Unpack Debian's Python and the libraries of wheels."""
    lists, packages = root / "lists", root / "packages"
    for folder in (lists / "partial", packages / "partial", root / "dpkg"):
        folder.mkdir(parents=True, exist_ok=True)
    (root / "dpkg" / "status").touch()
    options = {
        "APT::Architecture": "arm64",
        "APT::Architectures": "arm64",
        "Dir::State::Lists": lists,
        "Dir::State::status": root / "dpkg" / "status",
        "Dir::Cache::Archives": packages,
        "Dir::Cache::pkgcache": "",
        "Dir::Cache::srcpkgcache": "",
        "Debug::NoLocking": "true",
    }
    apt = [
        "apt-get",
        "--yes",
        *(word for one in options.items() for word in ("-o", "=".join(map(str, one)))),
    ]
    subprocess.run([*apt, "update"], check=True)
    wanted = [f"python{PYTHON}", "libstdc++6", "libgomp1"]
    subprocess.run(
        [*apt, "--no-install-recommends", "--download-only", "install", *wanted], check=True
    )
    for package in sorted(packages.glob("*.deb")):
        subprocess.run(["dpkg-deb", "-x", package, root], check=True)


def add_wheels(root: Path) -> None:
    """Install what topoloc and its tests need for aarch64, at the versions of constraints.txt."""
    project = tomllib.loads((HERE / "pyproject.toml").read_text())["project"]
    tools = {"beartype", "hypothesis", "jsonschema", "onnx", "pyproj", "pytest", "scipy"}
    listed = map(Requirement, project["dependencies"] + project["optional-dependencies"]["test"])
    wanted = [
        one
        for one in listed
        if (one.marker is None or one.marker.evaluate(ARM))
        and (str(one) in project["dependencies"] or one.name in tools)
    ]
    platforms = [f"manylinux_2_{k}_aarch64" for k in (17, 26, 27, 28, 31, 34)] + [
        "manylinux2014_aarch64"
    ]
    options = [word for one in platforms for word in ("--platform", one)]
    options += [word for one in ("cp311", "abi3", "none") for word in ("--abi", one)]
    options += ["--python-version", PYTHON, "--implementation", "cp", "--only-binary", ":all:"]
    install = [sys.executable, "-m", "pip", "install", "--quiet", "--target", root / "site"]
    libraries = [f"{one.name}{one.specifier}" for one in wanted]
    constraints = ["--constraint", HERE / "constraints.txt"]
    subprocess.run([*install, *constraints, *options, *libraries], check=True)
    subprocess.run([*install, "--no-deps", HERE], check=True)


def compare_queries(run: Callable[..., int], demo: Path, root: Path) -> int:
    """Localize the walks of the demo here and emulated. Return 1 if answers differ."""
    from topoloc.demo.recordings import SHIPPED

    failed = False
    for walk in WALKS:
        answers = list[dict[float, np.ndarray]]()
        for is_here in (True, False):
            out = root / f"{walk}.tum"
            out.unlink(missing_ok=True)
            words = ["localize", demo / "lab.topo", SHIPPED / walk, "--single", "--tum", out]
            if is_here:
                subprocess.run([sys.executable, "-c", WITHOUT_POSELIB, *words])
            else:
                run("-m", "topoloc", *words)
            poses = np.loadtxt(out, ndmin=2)  # status 1: an image was refused
            answers.append(dict(zip(poses[:, 0], poses[:, 1:4], strict=True)))
        both = answers[0].keys() & answers[1].keys()
        others = len(answers[0].keys() ^ answers[1].keys())
        largest = max((np.linalg.norm(answers[0][t] - answers[1][t]) for t in both), default=0.0)
        print(f"{walk}: {len(both)} of both, {others} of one only, up to {1000 * largest:.2f} mm")
        failed |= others > 0 or largest > MAX_DIFFERENCE
    return int(failed)


if __name__ == "__main__":
    sys.exit(main())
