"""Check shapes of annotations in each test, and find the recordings beside the project."""

from __future__ import annotations

import logging
import os
import pkgutil
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from hypothesis import settings

import topoloc
import topoloc_paper
import topoloc_training
import topoloc_worlds
from checked_shapes import check
from made_once import share_in
from topoloc import compiled


def _modules_with_checked_shapes() -> list[str]:
    """Return all leaf modules except Numba kernels, which cannot be wrapped, and messages whose
    types DDS reads itself."""
    packages = (topoloc, topoloc_worlds, topoloc_training, topoloc_paper)
    modules = [
        m
        for package in packages
        for m in pkgutil.walk_packages(package.__path__, f"{package.__name__}.")
    ]
    return [
        m.name
        for m in modules
        if not m.ispkg and not m.name.endswith(("_kernels", ".ros_messages"))
    ]


check(_modules_with_checked_shapes())

settings.register_profile("busy machine", deadline=None)
settings.load_profile("busy machine")

SHARED = Path(os.environ.get("TOPOLOC_SHARED", Path(__file__).parents[2] / "shared")).resolve()


@pytest.fixture(scope="session")
def shared() -> Path:
    """Return the folder of real recordings and reference values."""
    if not (SHARED / "data").is_dir():
        pytest.skip(f"no recordings at {SHARED} (set TOPOLOC_SHARED)")
    return SHARED


@pytest.fixture(autouse=True)
def threads_of_the_process_are_restored() -> Iterator[None]:
    """Restore the number of threads. `topoloc serve`, called in this process, sets it to 1."""
    before = list(compiled._configured)
    yield
    if compiled._configured != before:
        topoloc.set_num_threads(before[0] if before else compiled._DEFAULT_NUM_THREADS)
        compiled._configured[:] = before


@pytest.fixture(scope="session", autouse=True)
def no_networks_but_the_tests_own(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """Set an empty cache, so that tests do not depend on networks that the user downloaded."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("TOPOLOC_CACHE", str(tmp_path_factory.mktemp("cache")))
        yield


@pytest.fixture(scope="session", autouse=True)
def of_all_workers(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Create a folder of files that all processes of this test run read."""
    base = tmp_path_factory.getbasetemp()
    folder = (base.parent if "PYTEST_XDIST_WORKER" in os.environ else base) / "of-all-workers"
    folder.mkdir(exist_ok=True)
    share_in(folder)
    return folder


@pytest.fixture(scope="session")
def tiny_recording(of_all_workers: Path) -> Path:
    """Return a small rendered room as a stereo recording (KITTI-like, 14 pairs of 320x240) with
    exact truth.tum and a camera.json.

    It is read-only, because all tests share it. `tiny_world` renders more of the same place, or
    others.
    """
    from built_room import recorded_room  # after the hook above

    return recorded_room(of_all_workers / "tiny" / "room")


@pytest.fixture(scope="session")
def room_map(tiny_recording: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the map of `tiny_recording`, of SURF alone. Read-only."""
    from built_room import built_room

    path = tmp_path_factory.mktemp("map") / "room.topo"
    built_room(tiny_recording).save(path)
    return path


@pytest.fixture(scope="session")
def queries(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder of images of the room, with calibration and truth. Read-only."""
    from built_room import unseen_views, write_pictures

    return write_pictures(tmp_path_factory.mktemp("queries") / "unseen", unseen_views())


@pytest.fixture
def complaint(capfd: pytest.CaptureFixture[str], tmp_path: Path) -> Callable[..., str]:
    """Return a function that runs a failing command and returns its one line on stderr. The command
    may not create, resize or delete a file."""
    from topoloc.apps.cli import main  # after the hook above

    def run(*args: object, status: int = 1) -> str:
        before = {path: path.stat().st_size for path in tmp_path.rglob("*")}
        capfd.readouterr()
        assert main([str(arg) for arg in args]) == status
        printed = capfd.readouterr()
        assert printed.err.startswith("error: ")
        assert printed.err.count("\n") == 1
        assert "Traceback" not in printed.err
        assert {path: path.stat().st_size for path in tmp_path.rglob("*")} == before
        return printed.err

    return run


@pytest.fixture(autouse=True)
def loggers_of_the_service_are_plain() -> Iterator[None]:
    """Restore loggers for `caplog`: `topoloc serve` configures them, and import-linter
    disables them."""
    yield
    for name in ("topoloc.apps.service", "uvicorn", "asyncio"):
        logger = logging.getLogger(name)
        logger.handlers, logger.propagate, logger.disabled = [], True, False
        logger.setLevel(logging.NOTSET)
