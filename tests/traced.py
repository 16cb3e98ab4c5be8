"""Commands in processes of their own, with a home and a folder for temporary files of their own:
which files they leave, and to which addresses they speak. Linux with strace only; tests skip with
a reason where it is missing or not allowed."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import pytest

_ROOT = Path(__file__).parents[1]
_CALLS = "connect,sendto,sendmsg,sendmmsg,openat,open,creat,mkdir,mkdirat,rename,renameat,renameat2"
_LOOPBACK = re.compile(r"127\.\d+\.\d+\.\d+|::1|::ffff:127\.\d+\.\d+\.\d+")
_ADDRESS = re.compile(
    r"^\d+ +(?P<call>connect|sendto|sendmsg|sendmmsg)\(.*?sin6?_port=htons\((?P<port>\d+)\)"
    r".*?(?:inet_addr\(|inet_pton\(AF_INET6, )\"(?P<host>[^\"]+)\""
)
_MADE = re.compile(r"^\d+ +(?:mkdir|open\w*|creat|rename)\(.*?\"(?P<path>/[^\"]*)\"(?P<how>.*)")
# Of the machine, not of a user: devices, files of the kernel, compiled modules beside their source.
_SYSTEM = re.compile(r"/(?:dev|proc|sys)/|.*/__pycache__(?:/|$)")
# Set by this machine or this test run, and not by the user of a fresh machine.
_FOREIGN = re.compile(r"TOPOLOC_CACHE|XDG_|ORT_|MPL|MATPLOTLIB|RAY_|DRJIT_|.*_proxy$|PYTEST_")
# Where one of these is set, ONNX Runtime sends nothing by itself: a test run of a service.
_OF_SERVICES = re.compile(
    "CI|TF_BUILD|GITHUB_ACTIONS|GITLAB_CI|CIRCLECI|TRAVIS|JENKINS_URL|CODEBUILD_BUILD_ID"
    "|BUILDKITE|TEAMCITY_VERSION"
)


def users_environment() -> dict[str, str]:
    """The variables of this process that the user of a fresh machine would have, too."""
    return {
        name: value
        for name, value in os.environ.items()
        if not _FOREIGN.match(name) and not _OF_SERVICES.fullmatch(name)
    }


@dataclass(frozen=True)
class Traced:
    """Runs commands in `folder` and finds what they should not do."""

    home: Path
    temporary: Path
    folder: Path

    @staticmethod
    def in_folder(base: Path) -> Traced:
        """Make the folders. Skips the test if no process can be traced."""
        if reason := _find_reason():
            pytest.skip(reason)
        made = Traced(*(base / name for name in ("home", "tmp", "out")))
        for folder in (made.home, made.temporary, made.folder):
            folder.mkdir(parents=True)
        return made

    @property
    def trace(self) -> Path:
        """The file of the system calls."""
        return self.folder.parent / "trace"

    @property
    def environment(self) -> dict[str, str]:
        """The environment of the commands."""
        sources = [_ROOT / part / "src" for part in ("", "worlds", "training")]
        return users_environment() | {
            "HOME": str(self.home),
            "TMPDIR": str(self.temporary),
            "PYTHONPATH": os.pathsep.join(map(str, sources)),
            "PYTHONUNBUFFERED": "1",
        }

    def command(self, *args: object, detached: bool = False) -> list[str]:
        """A command of topoloc under strace; `detached`: its process is the command's own."""
        strace = ["strace", *(["-D"] if detached else []), "-f", "-o", str(self.trace)]
        topoloc = [sys.executable, "-m", "topoloc", *map(str, args)]
        return [*strace, "--seccomp-bpf", "-e", f"trace={_CALLS}", *topoloc]

    def run(self, *args: object) -> str:
        """Run a command that must succeed; what it printed."""
        done = subprocess.run(
            self.command(*args),
            cwd=self.folder,
            env=self.environment,
            capture_output=True,
            text=True,
            timeout=300,
            check=False,
        )
        assert done.returncode == 0, done.stderr
        return done.stdout + done.stderr

    def addresses(self) -> list[str]:
        """Addresses beyond this machine that were connected or written to, and name servers."""
        found = map(_ADDRESS.match, self.trace.read_text(errors="replace").splitlines())
        return [
            f"{one['call']} {one['host']} {one['port']}"
            for one in found
            if one and (one["port"] == "53" or not _LOOPBACK.fullmatch(one["host"]))
        ]

    def foreign_files(self) -> list[str]:
        """Files in the home but for those of our own cache, left temporary files, and whatever was
        made elsewhere."""
        cache_folder = self.home / ".cache" / "topoloc"
        left = [
            path
            for path in (*self.home.rglob("*"), *self.temporary.rglob("*"))
            if not path.is_relative_to(cache_folder) and path not in cache_folder.parents
        ]
        return [str(path.relative_to(self.folder.parent)) for path in left] + self._made_elsewhere()

    def _made_elsewhere(self) -> list[str]:
        own = (*(f"{folder}" for folder in (self.home, self.temporary, self.folder)),)
        made = map(_MADE.match, self.trace.read_text(errors="replace").splitlines())
        return [
            one["path"]
            for one in made
            if one
            and ("O_CREAT" in one["how"] or "O_" not in one["how"])
            and " = -1 " not in one["how"]
            and not one["path"].startswith(own)
            and not _SYSTEM.match(one["path"])
        ]


def assert_quiet(traced: Traced, allowed: Sequence[str] = ()) -> None:
    """Assert that nothing left the machine and that no foreign file appeared."""
    addresses = [one for one in traced.addresses() if one not in allowed]
    assert addresses == [], addresses
    files = traced.foreign_files()
    assert files == [], files


@cache
def _find_reason() -> str | None:
    """Why no process can be traced here."""
    if shutil.which("strace") is None:
        return "strace is not installed"
    tried = subprocess.run(
        ["strace", "-f", "--seccomp-bpf", "-o", os.devnull, "true"],
        capture_output=True,
        check=False,
    )
    return f"strace fails: {tried.stderr.decode()[-200:]}" if tried.returncode else None
