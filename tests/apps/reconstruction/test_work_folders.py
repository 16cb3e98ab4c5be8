"""Test the folders of computed poses: one user at a time, and no growth without end."""

from __future__ import annotations

import os
import threading
import time
from pathlib import Path

import pytest

from topoloc.apps.reconstruction import work_folders
from topoloc.apps.reconstruction.work_folders import open_work_folder


@pytest.fixture(autouse=True)
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("TOPOLOC_CACHE", str(tmp_path))
    return tmp_path / "reconstructions"


def test_a_second_build_of_the_same_images_waits():
    order, is_waiting, is_inside = list[str](), threading.Event(), threading.Event()

    def second() -> None:
        with open_work_folder("a", is_waiting.set):
            order.append("second")
            is_inside.set()

    with open_work_folder("a") as folder, open_work_folder("b"):
        (folder / "poses.npz").write_bytes(b"kept")
        thread = threading.Thread(target=second)
        thread.start()
        assert is_waiting.wait(10.0)
        assert not is_inside.wait(0.2)
        order.append("first")
    thread.join(10.0)
    assert order == ["first", "second"]
    assert (folder / "poses.npz").read_bytes() == b"kept"


def test_unused_folders_are_removed_unless_they_are_in_use(
    cache: Path, monkeypatch: pytest.MonkeyPatch
):
    for name in ("old", "new", "used"):
        with open_work_folder(name) as folder:
            (folder / "poses.npz").write_bytes(bytes(1000))
    long_ago = time.time() - 40 * 86_400
    with open_work_folder("used"):
        for name in ("old", "used"):
            os.utime(cache / name, (long_ago, long_ago))
        with open_work_folder("now"):
            assert {one.name for one in cache.iterdir()} == {"new", "used", "now"}
    monkeypatch.setattr(work_folders, "_MAX_BYTES", 999)
    with open_work_folder("now"):
        assert {one.name for one in cache.iterdir()} == {"now"}
