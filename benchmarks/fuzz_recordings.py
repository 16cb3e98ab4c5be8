"""Read pictures and recordings that were made to deceive, in child processes: how many crash, hang,
raise what they should not, or take much memory?

    python benchmarks/fuzz_recordings.py --mutations 100000 --first-seed 0

Whole ones are made first, and read: pictures of every type, and a small recording of every format
that is text and pictures. Each seed damages one file of one of them (bytes changed, cut off,
repeated, or a hostile word in place of a number). A child takes 200 seeds in a row: it reads each
picture, or opens the recording and reads its frames. Every finding is printed with its seed; exit
status 1 where there is any.
"""

from __future__ import annotations

import argparse
import json
import shutil
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np

BATCH, MAX_SECONDS, MAX_RSS_KB, NUM_FRAMES = 200, 5.0, 1_000_000, 3
K = "40 0 16 0 0 40 12 0 0 0 1 0"
POSES = [np.column_stack([np.eye(3), [0.1 * k, 0.0, 0.02 * k]]) for k in range(NUM_FRAMES)]
WORDS = (
    b"nan",
    b"1e999999999999",
    b"-1e308",
    b"9" * 5000,
    b"/etc/passwd",
    b"../../etc/passwd",
    b"[" * 100_000,
    b"\0",
    b'"',
    b"{",
    b"0",
    b"-1",
)


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--mutations", type=int, default=2000)
    parser.add_argument("--first-seed", type=int, default=0)
    parser.add_argument("--child", nargs=2, type=int, help=argparse.SUPPRESS)
    parser.add_argument("--whole", type=Path, help=argparse.SUPPRESS)
    asked = parser.parse_args()
    if asked.child:
        read_all(asked.whole, range(*asked.child))
        return 0
    outcomes, findings, slowest, largest, num_told = Counter(), [], 0.0, 0, 0
    with tempfile.TemporaryDirectory() as folder:
        whole = Path(folder) / "whole"
        make_whole(whole)
        check_whole(whole)
        at, end = asked.first_seed, asked.first_seed + asked.mutations
        while at < end:
            rows, why = _child(whole, at, min(at + BATCH, end))
            for row in rows:
                outcomes[f"{row['of']}: {row['outcome'].split(':')[0]}"] += 1
                slowest, largest = max(slowest, row["seconds"]), max(largest, row["rss_kb"])
                if (
                    row["seconds"] > MAX_SECONDS
                    or row["rss_kb"] > MAX_RSS_KB
                    or row["outcome"].startswith("!")
                ):
                    findings.append(
                        f"{row['seed']} ({row['of']}): {row['outcome']}, {row['seconds']:.1f} s,"
                        f" {row['rss_kb']} kB"
                    )
            at += len(rows)
            if why:
                findings.append(f"{at}: {why}")
                at += 1
            for finding in findings[num_told:]:
                print(finding, flush=True)
            num_told = len(findings)
    for outcome, count in sorted(outcomes.items()):
        print(f"{count:7d}  {outcome}")
    print(
        f"{sum(outcomes.values())} mutations, {len(findings)} findings, slowest {slowest:.1f} s,"
        f" largest {largest / 1e3:.0f} MB"
    )
    return 1 if findings else 0


def _child(whole: Path, first: int, end: int) -> tuple[list[dict], str]:
    """What a child said of each seed until it ended, and why it ended too early."""
    command = [sys.executable, __file__, "--whole", str(whole), "--child", str(first), str(end)]
    try:
        run = subprocess.run(command, capture_output=True, text=True, timeout=120.0, check=False)
        output, why = run.stdout, f"exit {run.returncode}: {run.stderr.strip()[-300:]}"
    except subprocess.TimeoutExpired as error:
        output, why = (
            (
                (error.stdout or b"").decode()
                if isinstance(error.stdout, bytes)
                else error.stdout or ""
            ),
            "hangs",
        )
    rows = [json.loads(line) for line in output.splitlines() if line.endswith("}")]
    return rows, "" if len(rows) == end - first else why


def make_whole(whole: Path) -> None:
    """Pictures in `pictures`, a folder a format beside it."""
    rng = np.random.default_rng(0)
    colour = rng.integers(0, 256, (24, 32, 3), dtype=np.uint8)
    deep = rng.integers(0, 65536, (24, 32), dtype=np.uint16)
    (whole / "pictures").mkdir(parents=True)
    for suffix in ("png", "jpg", "bmp", "ppm", "pgm", "tiff", "webp"):
        cv2.imwrite(
            str(whole / "pictures" / f"colour.{suffix}"),
            colour if suffix != "pgm" else colour[:, :, 0],
        )
    for suffix in ("png", "tiff", "pgm"):
        cv2.imwrite(str(whole / "pictures" / f"deep.{suffix}"), deep)
    cv2.imwrite(str(whole / "pictures" / "alpha.png"), np.dstack([colour, colour[:, :, 0]]))
    (whole / "pictures" / "plain.pgm").write_text("P2 4 2 255\n" + " ".join(map(str, range(8))))
    _recordings(whole, colour, deep)


def check_whole(whole: Path) -> None:
    """Hold that all of it can be read as long as nobody damages it."""
    for path in sorted(whole.iterdir()):
        for part in sorted(path.iterdir()) if path.name == "pictures" else [path]:
            said = _read_picture(part) if path.name == "pictures" else _read_recording(part)
            assert said == "read", f"{part}: {said}"


def _recordings(whole: Path, colour: np.ndarray, deep: np.ndarray) -> None:
    stamps = [f"{k}.5" for k in range(NUM_FRAMES)]
    tum = "\n".join(
        f"{stamp} {pose[0, 3]} 0 {pose[2, 3]} 0 0 0 1"
        for stamp, pose in zip(stamps, POSES, strict=True)
    )
    kitti = "\n".join(" ".join(map(str, pose.ravel())) for pose in POSES)
    camera = {
        "model": "PINHOLE",
        "width": 32,
        "height": 24,
        "fx": 40.0,
        "fy": 40.0,
        "cx": 16.0,
        "cy": 12.0,
        "baseline": 0.1,
    }
    texts = {
        "folder/camera.json": json.dumps(camera),
        "folder/times.txt": "\n".join(stamps),
        "folder/truth.tum": tum,
        "kitti/calib.txt": f"P0: {K}\nP1: {K.replace('16 0 0', '16 -4 0')}",
        "kitti/times.txt": "\n".join(stamps),
        "kitti/poses.txt": kitti,
        "tum/rgb.txt": "\n".join(f"{stamp} rgb/{k}.png" for k, stamp in enumerate(stamps)),
        "tum/depth.txt": "\n".join(f"{stamp} depth/{k}.png" for k, stamp in enumerate(stamps)),
        "tum/groundtruth.txt": tum,
        "tum/camera.json": json.dumps(
            {key: camera[key] for key in camera if key != "baseline"} | {"depth_factor": 5000.0}
        ),
        "nerfstudio/transforms.json": json.dumps(
            {"fl_x": 40.0, "fl_y": 40.0, "cx": 16.0, "cy": 12.0, "w": 32, "h": 24, "k1": 0.1}
            | {
                "frames": [
                    {
                        "file_path": f"images/{k}.png",
                        "transform_matrix": [*p.tolist(), [0, 0, 0, 1]],
                    }
                    for k, p in enumerate(POSES)
                ]
            }
        ),
        "colmap/sparse/0/cameras.txt": "1 OPENCV 32 24 40 40 16 12 0.1 0 0 0",
        "colmap/sparse/0/images.txt": "\n".join(
            f"{k + 1} 1 0 0 0 {0.1 * k} 0 0 1 {k}.png\n" for k in range(NUM_FRAMES)
        ),
        "colmap/sparse/0/points3D.txt": "1 0 0 5 1 2 3 0.5",
    }
    for k in range(NUM_FRAMES):
        pose = np.vstack([POSES[k], [0, 0, 0, 1]])
        texts[f"seven_scenes/frame-{k:06d}.pose.txt"] = "\n".join(
            " ".join(map(str, row)) for row in pose
        )
        for name in (
            "folder/left/{}.png",
            "folder/right/{}.png",
            "kitti/image_0/{:06d}.png",
            "kitti/image_1/{:06d}.png",
            "tum/rgb/{}.png",
        ):
            _write(whole / name.format(k), colour)
        for name in ("nerfstudio/images/{}.png", "colmap/images/{}.png"):
            _write(whole / name.format(k), colour)
        _write(whole / f"tum/depth/{k}.png", deep)
        _write(
            whole / f"seven_scenes/frame-{k:06d}.color.png", np.zeros((480, 640, 3), np.uint8)
        )  # its camera is built in
        _write(
            whole / f"seven_scenes/frame-{k:06d}.depth.png", np.full((480, 640), 1000, np.uint16)
        )
    for name, text in texts.items():
        (whole / name).parent.mkdir(parents=True, exist_ok=True)
        (whole / name).write_text(text)


def _write(path: Path, pixels: np.ndarray) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    cv2.imwrite(str(path), pixels)


def read_all(whole: Path, seeds: range) -> None:
    """The child: a line for each seed."""
    from topoloc.errors import TopolocError

    rngs = ((seed, np.random.default_rng(seed)) for seed in seeds)
    kinds = sorted(folder.name for folder in whole.iterdir())
    with tempfile.TemporaryDirectory() as folder:
        for seed, rng in rngs:
            of = "pictures" if rng.random() < 0.5 else kinds[rng.integers(len(kinds))]
            copy, start = Path(folder) / str(seed), time.process_time()
            shutil.copytree(whole / of, copy)
            files = sorted(path for path in copy.rglob("*") if path.is_file())
            texts = [path for path in files if path.suffix in (".txt", ".json", ".tum")]
            among = texts if texts and rng.random() < 0.8 else files
            damaged = among[rng.integers(len(among))]
            damaged.write_bytes(mutated(damaged.read_bytes(), rng))
            try:
                outcome = _read_picture(damaged) if of == "pictures" else _read_recording(copy)
            except TopolocError as error:
                outcome = (
                    type(error).__name__
                    if "\n" not in str(error)
                    else f"! an error of several lines: {error!r}"
                )
            except Exception as error:  # what nobody expects is what is sought
                outcome = f"! {type(error).__name__}: {str(error)[:200]}"
            row = {
                "seed": seed,
                "of": of,
                "outcome": outcome,
                "seconds": time.process_time() - start,
                "rss_kb": _peak_kb(),
            }
            print(json.dumps(row), flush=True)
            shutil.rmtree(copy)


def mutated(data: bytes, rng: np.random.Generator) -> bytes:
    """Damaged in one of five ways."""
    way, changed = rng.integers(5), bytearray(data)
    if way == 0:
        return data[: rng.integers(len(data) + 1)]
    if way == 1:  # a number becomes a hostile word
        numbers = list(_numbers(data))
        first, end = numbers[rng.integers(len(numbers))] if numbers else (0, 0)
        return data[:first] + WORDS[rng.integers(len(WORDS))] + data[end:]
    if way == 2:
        first, end = sorted(rng.integers(0, len(data) + 1, 2))
        return data[:end] + data[first:end] * int(rng.integers(1, 20)) + data[end:]
    for at in rng.integers(0, max(len(data), 1), rng.integers(1, 12)):
        if len(changed):
            changed[at] = rng.integers(0, 256) if way == 3 else changed[at] ^ (1 << rng.integers(8))
    return bytes(changed)


def _numbers(data: bytes) -> Iterator[tuple[int, int]]:
    """Where runs of digits begin and end; of a text, words also."""
    start = None
    for at, byte in enumerate(data[:20_000]):
        is_inside = bytes([byte]).isalnum() or byte in b".-"
        if is_inside and start is None:
            start = at
        if not is_inside and start is not None:
            yield start, at
            start = None


def _read_picture(path: Path) -> str:
    from topoloc.recordings.image_io import exif_focal_length, image_size, read_depth, read_image

    width, height = image_size(path)
    exif_focal_length(path, width, height)
    (read_depth if path.name.startswith("deep") else lambda path, _: read_image(path))(path, 1000.0)
    return "read"


def _read_recording(path: Path) -> str:
    from topoloc.recordings.open import open_sequence

    sequence = open_sequence(path)
    for k in range(min(len(sequence), 5)):
        sequence[k]
    return "read"


def _peak_kb() -> int:
    fields = dict(line.split(":", 1) for line in Path("/proc/self/status").read_text().splitlines())
    return int(fields["VmHWM"].split()[0])


if __name__ == "__main__":
    sys.exit(main())
