"""Nothing leaves the machine: commands as a user types them look up no name, connect to this
machine alone, and write outputs and our own cache only (docs/privacy.md)."""

from __future__ import annotations

import re
import signal
import subprocess
import tempfile
import time
from pathlib import Path

import pytest

import topoloc
from in_browser import chromium, opened
from topoloc.apps.cli import main
from topoloc.apps.viewer import page as viewer_page
from topoloc.demo.recordings import SHIPPED
from traced import Traced, assert_quiet

LAP, DAY = f"{SHIPPED / 'map_lap1'}@0:6", SHIPPED / "day"
IMAGE = DAY / "images" / "000000.jpg"
COMMANDS = {
    "build": ("build", LAP, "new.topo"),
    "slam": ("slam", LAP, "lap.tum"),
    "localize": ("localize", "lab.topo", f"{DAY}@0:1", "--json", "poses.jsonl"),
    "update": ("update", "lab.topo", f"{SHIPPED / 'map_lap2'}@0:8"),
    "evaluate": ("evaluate", "lab.topo", f"{DAY}@0:1", "--report", "report.html"),
    "explain": ("explain", "lab.topo", f"{DAY}@0", "--out", "page.html"),
    "export": ("export", "lab.topo", "colmap", "--format", "colmap"),
    "view": ("view", "lab.topo", "--out", "scene.html"),
    "doctor": ("doctor",),
}
TRAIN = ("train", "lab.topo", "--coarse", "vlad-nn", "--backbone", "compact")
# Chromium's question to the kernel which route leads there; as UDP it sends no packet.
ROUTE = "connect 2001:4860:4860::8888 443"


@pytest.fixture(scope="module")
def lab(tmp_path_factory: pytest.TempPathFactory) -> bytes:
    """A map with all feature types, so that networks run."""
    path = tmp_path_factory.mktemp("lab") / "lab.topo"
    topoloc.build_map(topoloc.open_sequence(LAP)).save(path)
    return path.read_bytes()


@pytest.fixture
def traced(tmp_path: Path, lab: bytes) -> Traced:
    traced = Traced.in_folder(tmp_path)
    (traced.folder / "lab.topo").write_bytes(lab)
    return traced


@pytest.mark.parametrize("name", COMMANDS)
def test_a_command_is_quiet(traced: Traced, name: str):
    traced.run(*COMMANDS[name])
    assert_quiet(traced)


def test_training_is_quiet(traced: Traced):
    pytest.importorskip("torch", reason="torch is not installed")
    traced.run(*TRAIN, "--weights", "scratch")
    assert_quiet(traced)


def test_a_screenshot_is_quiet(traced: Traced):
    try:
        viewer_page.find_browser()
    except topoloc.TopolocError as error:
        pytest.skip(str(error))
    traced.run("view", "lab.topo", "--screenshot", "lab.png")
    assert_quiet(traced, allowed=[ROUTE])


PAGES = {
    "report": (*COMMANDS["evaluate"][:3], "--report"),
    "weak parts": ("evaluate", "lab.topo", "--against-itself", "--report"),
    "explanation": (*COMMANDS["explain"][:3], "--out"),
    "scene": ("view", "lab.topo", "--out"),
}


@pytest.mark.parametrize("name", PAGES)
def test_a_page_loads_nothing_from_elsewhere(
    name: str, lab: bytes, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.chdir(tmp_path)
    Path("lab.topo").write_bytes(lab)
    assert main([*PAGES[name], "page.html"]) == 0
    with chromium() as browser, opened(browser, (tmp_path / "page.html").as_uri(), 1300) as page:
        page.wait_for_load_state("networkidle")


def test_a_page_that_loads_from_elsewhere_is_seen(tmp_path: Path):
    (tmp_path / "page.html").write_text("<link rel=icon href=data:,><img src=other.png>")
    address = (tmp_path / "page.html").as_uri()
    with (
        chromium() as browser,
        pytest.raises(AssertionError, match=r"other\.png"),
        opened(browser, address, 400) as page,
    ):
        page.wait_for_load_state("networkidle")


def test_a_temporary_cluster_is_quiet():
    pytest.importorskip("ray", reason="Ray is not installed (the extra cluster)")
    recordings = [f"{SHIPPED / name}@0:4" for name in ("map_lap1", "map_lap2")]
    with tempfile.TemporaryDirectory(prefix="q-") as short:  # sockets lie in it
        traced = Traced.in_folder(Path(short))
        traced.run("build", *recordings, "campus", "--ray", "local")
        assert_quiet(traced)


def test_a_served_request_is_quiet(traced: Traced):
    process = subprocess.Popen(
        traced.command("serve", "lab.topo", "--port", 0, detached=True),
        cwd=traced.folder,
        env=traced.environment,
        stderr=subprocess.PIPE,
        text=True,
    )
    assert process.stderr is not None
    try:
        lines = iter(process.stderr.readline, "")
        url = next(one[1] for line in lines if (one := re.search(r"serves on (\S+)", line)))
        with topoloc.Client(url) as client:
            assert isinstance(client.localize("lab", IMAGE, "map"), topoloc.Localization)
        process.send_signal(signal.SIGTERM)
        assert process.wait(60) == 0
    finally:
        process.kill()
        process.stderr.close()
    deadline = time.monotonic() + 20  # the tracer writes on for a moment
    while "+++ exited" not in traced.trace.read_text(errors="replace")[-200:]:
        assert time.monotonic() < deadline
        time.sleep(0.05)
    assert_quiet(traced)


def test_a_look_up_and_a_foreign_file_are_seen(tmp_path: Path):
    """What the others assert can fail."""
    traced = Traced.in_folder(tmp_path)
    code = (
        "import os, pathlib, socket; (pathlib.Path.home() / 'id').touch();"
        " pathlib.Path(os.environ['ELSEWHERE']).touch();"
        " socket.socket(type=socket.SOCK_DGRAM).connect(('192.0.2.1', 53))"
    )
    command = traced.command()[:-2]  # without `-m topoloc`
    elsewhere = tmp_path / "elsewhere"
    subprocess.run(
        [*command, "-c", code],
        env=traced.environment | {"ELSEWHERE": str(elsewhere)},
        check=True,
    )
    assert traced.addresses() == ["connect 192.0.2.1 53"]
    assert traced.foreign_files() == ["home/id", str(elsewhere)]
