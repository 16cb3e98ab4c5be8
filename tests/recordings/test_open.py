import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from tiny_recordings import assert_same_pose, assert_slices, picture, write
from topoloc.errors import RecordingError, UnknownFormatError, UnreadableImageError
from topoloc.recordings.format import natural_key
from topoloc.recordings.frame import SequenceView, StereoSequence, sequence_subset
from topoloc.recordings.frame_preparation import prepare_frame
from topoloc.recordings.open import FORMATS, load_format, open_sequence, parse_selection
from topoloc.recordings.recording import Recording, as_monocular, read_left_frame


@pytest.mark.parametrize("name", ["kitti", "euroc", "tum", "seven_scenes"])
def test_every_format_is_recognised_by_itself_alone(name: str, request: pytest.FixtureRequest):
    path = request.getfixturevalue(name)
    assert [
        known
        for known, candidate in ((name, load_format(name)) for name in FORMATS)
        if candidate.can_open(path) and known != "folder"
    ] == [name]
    sequence, named = open_sequence(str(path)), open_sequence(path, format=name)
    assert isinstance(sequence, StereoSequence)
    assert sequence.names == named.names
    assert (
        len(sequence)
        == len(sequence.names)
        == len(sequence.t_ns)
        == len(sequence.poses)
        == len(list(sequence))
    )
    assert_slices(sequence)
    assert_slices(as_monocular(sequence))


def test_opening_reads_no_picture(kitti: Path, euroc: Path, tum: Path, seven_scenes: Path):
    for path in (euroc, tum, seven_scenes):
        for file in path.rglob("*.png"):
            file.write_bytes(b"")
        assert len(open_sequence(path)) > 0
    for file in kitti.rglob("00000[12].png"):
        file.write_bytes(b"")
    assert len(open_sequence(kitti)) == 3


@pytest.mark.parametrize(
    ("held", "nearest"),
    [
        ("notes.txt", ""),
        ("rgb.txt", "; nearest is tum: rgb.txt and depth.txt"),
        ("transforms.json.orig", ""),
        ("left", "; nearest is folder: pictures, or left/ and right/"),
    ],
)
def test_errors_of_unknown_folders_name_their_content_and_the_nearest_format(
    held: str, nearest: str, tmp_path: Path
):
    (tmp_path / held).write_text("nothing")
    with pytest.raises(UnknownFormatError) as error:
        open_sequence(tmp_path)
    assert f"{tmp_path}: no known recording: here is {held}{nearest}" in str(error.value)
    assert str(error.value).endswith("; formats: docs/recordings.md")
    assert len(str(error.value)) - len(str(tmp_path)) < 200
    assert "\n" not in str(error.value)


def test_unknown_names(tmp_path: Path):
    with pytest.raises(UnknownFormatError, match=r"betamax.*kitti"):
        open_sequence(tmp_path, format="betamax")
    with pytest.raises(RecordingError, match="nowhere: no such"):
        open_sequence(tmp_path / "nowhere")
    (tmp_path / "a.mp3").write_bytes(b"la la la")
    with pytest.raises(UnknownFormatError, match=r"a\.mp3"):
        open_sequence(tmp_path / "a.mp3")


def test_a_plain_folder_loads_no_other_format(tmp_path: Path):
    write(tmp_path / "0.png", picture(0))
    program = """if True:
        import sys
        from topoloc.recordings.open import open_sequence
        assert len(open_sequence(sys.argv[1], format="folder")) == 1
        print(*(name for name in sys.modules if "formats" in name))"""
    command = [sys.executable, "-c", program, str(tmp_path)]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    assert done.stdout.split() == []


@pytest.mark.parametrize("name", FORMATS)
def test_a_named_format_that_does_not_fit(tmp_path: Path, name: str):
    with pytest.raises(RecordingError, match=str(tmp_path)):
        open_sequence(tmp_path, format=name)


@pytest.mark.parametrize(
    ("text", "chosen"),
    [
        ("0::2", [0, 2, 4, 6, 8]),
        (":3", [0, 1, 2]),
        ("-2:", [8, 9]),
        ("7:99", [7, 8, 9]),
        ("0:2,5:7", [0, 1, 5, 6]),
        ("5:7, 0:6:3", [0, 3, 5, 6]),
        ("0-1/4", [0, 1, 4, 5, 8, 9]),
        ("2-3/4", [2, 3, 6, 7]),
        ("4", [4]),
        ("-1", [9]),
        ("20:30", []),
    ],
)
def test_selections(text: str, chosen: list[int]):
    assert parse_selection(text, 10) == chosen


@pytest.mark.parametrize(
    "text", ["", "a", "1:2:0", "1:2:-1", "0-5", "0-5/0", "10", "-11", "1:2;3:4"]
)
def test_bad_selections(text: str):
    with pytest.raises(RecordingError):
        parse_selection(text, 10)


def test_a_part_of_a_recording(kitti: Path):
    whole, part = open_sequence(kitti), open_sequence(f"{kitti}@0::2")
    assert part.names == ["image_0/000000.png", "image_0/000002.png"]
    assert part.t_ns == [0, 200_000_000]
    assert_same_pose(part.poses[1], whole.poses[2])
    np.testing.assert_array_equal(part[1].image, whole[2].image)
    assert_same_pose(part[-1].world_from_cam, whole[2].world_from_cam)
    with pytest.raises(RecordingError, match="none of the 3"):
        open_sequence(f"{kitti}@5:")
    with pytest.raises(RecordingError, match="chooses no frames"):
        open_sequence(f"{kitti}@every second")


def test_a_folder_with_an_at_sign_in_its_name(tmp_path: Path):
    write(tmp_path / "me@home" / "a.png", picture(0))
    assert len(open_sequence(tmp_path / "me@home")) == 1
    assert len(open_sequence(f"{tmp_path / 'me@home'}@0")) == 1


@pytest.mark.parametrize("name", ["kitti", "tum", "seven_scenes"])
def test_a_left_frame_is_described_as_the_whole_one_and_its_other_picture_not_read(
    name: str, request: pytest.FixtureRequest
):
    recording = sequence_subset(open_sequence(request.getfixturevalue(name)), [1])
    whole = prepare_frame(recording[0], with_depth=False)
    assert isinstance(recording, SequenceView)
    base = recording.base
    assert isinstance(base, Recording)
    other = base.right or base.depth
    assert other is not None
    other.paths[1].unlink()
    with pytest.raises(UnreadableImageError):
        recording[0]
    left = read_left_frame(recording, 0)
    assert left.right is None
    assert left.depth is None
    assert left.world_from_cam is recording.poses[0]
    view = prepare_frame(left, with_depth=False)
    np.testing.assert_array_equal(view.picture, whole.picture)
    assert view.camera == whole.camera
    np.testing.assert_array_equal(view.view_from_cam.matrix(), whole.view_from_cam.matrix())


def test_a_subset_keeps_its_order_and_its_bounds(plain: Callable[..., Path]):
    sequence = open_sequence(plain(""))
    subset = sequence_subset(sequence, [2, 0])
    assert [subset[0].name, subset[1].name] == ["view10.png", "view1.png"]
    assert [frame.name for frame in sequence_subset(subset, [1])] == ["view1.png"]
    with pytest.raises(IndexError):
        sequence_subset(sequence, [3])
    with pytest.raises(IndexError):
        subset[2]


def test_names_are_sorted_by_their_numbers_however_long():
    names = ["frame10.png", "frame9.png", "frame" + "9" * 5000 + ".png", "frame010b.png", "1.png"]
    assert sorted(names, key=natural_key) == [
        "1.png",
        "frame9.png",
        "frame10.png",
        "frame010b.png",
        "frame" + "9" * 5000 + ".png",
    ]
