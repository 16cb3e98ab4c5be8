"""Check that the help of an option is one paragraph, and that Nerfstudio poses are
no trajectory."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest

from topoloc.apps.cli import main


@pytest.mark.parametrize(
    ("command", "sentence"),
    [
        ("localize", "`fx,fy,cx,cy` in pixels, `map` for the map's camera, `unknown` to estimate"),
        ("georeference", "lines of `time,lat,lon,h` or `name of a mapping image,lat,lon,h`."),
        ("undo", "byte-identical to the file before its last edit. Or an atlas, with `--tile`."),
    ],
)
def test_a_wide_help_keeps_a_sentence_on_its_line(
    command: str, sentence: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    monkeypatch.setenv("COLUMNS", "300")
    with pytest.raises(SystemExit):
        main(["help", command])
    assert sentence in capsys.readouterr().out


def test_poses_of_nerfstudio_are_no_trajectory(
    tiny_recording: Path, tmp_path: Path, complaint: Callable[..., str]
):
    target, poses = tmp_path / "a.topo", tmp_path / "transforms.json"
    poses.write_text("{}", encoding="utf-8")
    said = complaint("build", tiny_recording, target, "--trajectory", poses, status=2)
    assert f"map {poses} itself, as the recording" in said
