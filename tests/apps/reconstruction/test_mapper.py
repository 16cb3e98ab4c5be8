"""Test where a stopped run of the mapper continues, and that its process loads no OpenCV. What it
computes is tested with `photos.py`."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

from topoloc.apps.reconstruction.mapper import _latest_snapshot


def test_the_latest_whole_snapshot_is_continued(tmp_path: Path):
    assert _latest_snapshot(tmp_path) is None
    for name in ("1795981873485", "1795982113461", "1795982557940"):
        (tmp_path / name).mkdir()
    for name in ("1795981873485", "1795982113461"):  # the last one was being written
        (tmp_path / name / "points3D.bin").touch()
    assert _latest_snapshot(tmp_path) == tmp_path / "1795982113461"


def test_the_process_loads_no_opencv():
    code = "import sys, topoloc.apps.reconstruction.mapper; sys.exit('cv2' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0
