"""Check that truncated bags are read up to the damage, and that any bytes raise only
topoloc's errors."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from bag_writing import FEATURE_TYPES

from topoloc.errors import RecordingError, TopolocError
from topoloc.recordings.frame import StereoSequence
from topoloc.recordings.open import open_sequence
from topoloc.recordings.recording import recording_notes

FileOf = Callable[[str], Path]


@pytest.mark.parametrize("kind", FEATURE_TYPES)
def test_a_bag_that_was_cut_off(
    kind: str, walk: StereoSequence, file_of: FileOf, capsys: pytest.CaptureFixture[str]
):
    path = file_of(kind)
    whole = path.read_bytes()
    path.write_bytes(whole[: int(len(whole) * 0.75)])
    sequence = open_sequence(path)
    assert 2 <= len(sequence) < len(walk)
    assert any("what is whole is used" in note for note in recording_notes(sequence))
    for index in range(len(sequence)):
        assert sequence.t_ns[index] == walk.t_ns[index]
        np.testing.assert_array_equal(sequence[index].image, walk[index].image)


def test_the_command_reports_a_truncated_bag(
    file_of: FileOf, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    from topoloc.apps.cli.output import open_recording

    path = file_of("ros2-mcap")
    path.write_bytes(path.read_bytes()[:-2000])
    assert len(open_recording(str(path), None)) > 0
    said = capsys.readouterr().err
    assert said.startswith("warning: ")
    assert "cut off or damaged after" in said


def test_a_bag_that_was_never_closed(file_of: FileOf, walk: StereoSequence):
    """A killed recorder leaves a bag without an index, which its header shows."""
    path = file_of("ros1")
    data = path.read_bytes()
    place = data.index(b"index_pos=") + len(b"index_pos=")
    path.with_suffix(".bag.active").write_bytes(data[:place] + bytes(8) + data[place + 8 :])
    sequence = open_sequence(path.with_suffix(".bag.active"))
    assert len(sequence) == len(walk)
    assert "never closed" in recording_notes(sequence)[0]


@pytest.mark.parametrize(
    "content",
    [
        b"",
        b"#ROSBAG V2.0\n",
        b"\x89MCAP0\r\n",
        b"SQLite format 3\0" + bytes(200),
        b"something else",
    ],
)
@pytest.mark.parametrize("suffix", [".bag", ".db3", ".mcap"])
def test_files_that_are_no_bags(content: bytes, suffix: str, tmp_path: Path):
    path = tmp_path / f"walk{suffix}"
    path.write_bytes(content)
    with pytest.raises(RecordingError):
        open_sequence(path)


def test_a_folder_packed_as_a_whole(tmp_path: Path):
    (tmp_path / "metadata.yaml").write_text("rosbag2_bagfile_information: {}\n")
    with pytest.raises(RecordingError, match=r"no \.db3 and no \.mcap file here"):
        open_sequence(tmp_path)
    (tmp_path / "walk_0.db3.zstd").write_bytes(b"\x28\xb5\x2f\xfd")
    with pytest.raises(
        RecordingError, match=r"walk_0\.db3\.zstd is packed as a whole: `zstd -d` unpacks it"
    ):
        open_sequence(tmp_path)


def test_a_topic_whose_name_is_damaged_is_not_shown(file_of: FileOf):
    path = file_of("ros1")
    path.write_bytes(
        path.read_bytes()
        .replace(b"/left/image_rect", b"/left/imag\n\x07rect")
        .replace(b"/right/image_rect", b"/right/imag\n\x07rect")
    )
    with pytest.raises(
        RecordingError, match=r"no topic of pictures; there are /left/camera_info \(sensor_msgs"
    ) as failure:
        open_sequence(path)
    assert str(failure.value).isprintable()


@pytest.mark.parametrize("kind", FEATURE_TYPES)
def test_changed_bytes_raise_only_topoloc_errors(kind: str, file_of: FileOf, tmp_path: Path):
    """Change bytes outside of image data, mostly in lengths."""
    path = file_of(kind)
    whole = path.read_bytes()
    rng = np.random.default_rng(3)
    num_opened, said = 0, ""
    for number in range(60):
        data = bytearray(whole)
        for place in rng.integers(0, len(whole), 4) if number % 3 else rng.integers(0, 6000, 3):
            data[place] = rng.choice([0, 1, 127, 255, int(rng.integers(256))])
        if number % 5 == 0:
            del data[int(rng.integers(len(data))) :]
        changed = tmp_path / f"changed{number}{path.suffix}"
        changed.write_bytes(data)
        try:
            sequence = open_sequence(changed, "rosbag")
            num_opened += 1
            for index in range(len(sequence)):
                sequence[index]
        except TopolocError as error:
            said += str(error)
        changed.unlink()
    assert num_opened > 0
    assert "\n" not in said
