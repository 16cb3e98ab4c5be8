"""The jobs that take minutes: training, the paper's command, damaged files, the slow tests."""

from __future__ import annotations

import json
import random
import re
import shutil
import sys
from collections import Counter
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

from topoloc.mapping.edit import kept_path

from .edits import digest
from .figures import Figure
from .workplace import FIXTURES, ROOT, JobError, Workplace, last_line, need_module, run

WEIGHTS = "squeezenet1_1-imagenet-features.pth"
NUM_DAMAGED = 500


def train(work: Workplace) -> Iterator[Figure]:
    """Train cnn-nn on a map of 60 images, and query the map with it."""
    need_module("torch")
    path = work.folder / "zed.topo"
    work.topoloc("build", work.data("zed_lab/session1@0:60"), path)
    stored = work.shared / "weights" / WEIGHTS
    weights = ("--weights", stored if stored.exists() else "scratch")
    trained = work.answer("train", path, "--coarse", "cnn-nn", *weights)
    yield Figure("cnn-nn: the map has it", int(trained["name"] == "cnn-nn"), "at least")
    session = work.data("zed_lab/session2@0:60:4")
    lines = work.answer("localize", path, session, "--single", "--coarse", "cnn-nn")
    found = sum(line["localized"] for line in lines)
    yield Figure(f"cnn-nn: localized of {len(lines)}", found, "at least")


def paper(work: Workplace) -> Iterator[Figure]:
    """Run the paper's command as a user types it."""
    need_module("torch")
    out = work.folder / "paper"
    work.topoloc("benchmark", "paper", "--quick", "--out", out, timeout=580)
    results = json.loads((out / "results.json").read_text(encoding="utf-8"))
    for table in ("accuracy", "nodes", "peers", "ablation"):
        yield Figure(f"rows of the table {table}", len(results[table]), "at least")
    ours = [row for row in results["accuracy"] if row["method"] == "surf-vlad"]
    yield Figure("surf-vlad: localized", sum(row["num_localized"] for row in ours), "at least")
    page = (out / "report.html").stat().st_size
    yield Figure("report.html is not empty", int(page > 10_000), "at least")


def fuzz(work: Workplace) -> Iterator[Figure]:
    """Read damaged maps, recordings and undo files; kill edits."""
    small = work.folder / "small.topo"
    work.topoloc("build", work.data("zed_lab/session1@0:40:4"), small, "--features", "surf")
    picture = next(iter(sorted((Path(work.data("zed_lab/session2")) / "image_0").iterdir())))
    camera = FIXTURES / "queries" / "camera.json"
    maps = ("fuzz_maps.py", small, picture, camera, "--mutations", 500)
    yield _of_script(work, "damaged maps of 500: findings", *maps)
    recordings = ("fuzz_recordings.py", "--mutations", 2000)
    yield _of_script(work, "damaged recordings of 2000: findings", *recordings)
    yield _of_script(
        work, "killed edits of 50: broken or left", "kill_edits.py", small, "--kills", 50
    )
    with ThreadPoolExecutor(2) as pool:
        outcomes = Counter(pool.map(lambda seed: _damaged_undo(work, seed), range(NUM_DAMAGED)))
    for outcome in ("traceback", "hang", "another map"):
        name = f"damaged undo files of {NUM_DAMAGED}: {outcome}"
        yield Figure(name, outcomes[outcome], "at most")


def test_slow(work: Workplace) -> Iterator[Figure]:
    """Run the slow tests."""
    need_module("pytest")
    words = [sys.executable, "-m", "pytest", "-m", "slow", "-x", "-p", "no:cacheprovider"]
    code, out, err = run(words, ROOT, timeout=900)
    if code != 0:
        raise JobError(last_line(out) or last_line(err))
    yield Figure("make test-slow passes", int(code == 0), "at least")


def _of_script(work: Workplace, name: str, script: str, *words: object) -> Figure:
    """Run a script of benchmarks/ and count what it found."""
    command = [sys.executable, ROOT / "benchmarks" / script, *words]
    code, out, err = run(command, work.folder, timeout=500)
    counts = [
        int(number)
        for number in re.findall(r"(\d+) (?:findings|times broken|times something)", out)
    ]
    if not counts:
        raise JobError(f"{script}: exit status {code}: {last_line(err) or last_line(out)}")
    return Figure(name, max(sum(counts), int(code != 0)), "at most")


def _damaged_undo(work: Workplace, seed: int) -> str:
    """Damage the kept file of a map, run `topoloc undo`, and return the outcome."""
    folder = work.folder / f"undo{seed}"
    folder.mkdir()
    after, before = FIXTURES / "pruned.topo", FIXTURES / "schema_3.topo"
    path = folder / after.name
    shutil.copy(after, path)
    kept = kept_path(path, digest(after), digest(before))
    kept.write_bytes(_damaged(before.read_bytes(), random.Random(seed)))
    try:
        words = [sys.executable, "-m", "topoloc", "undo", path]
        code, _, err = run(words, folder, timeout=30)
    except JobError:
        return "hang"
    same = path.read_bytes()
    shutil.rmtree(folder, ignore_errors=True)
    if "Traceback" in err or code not in (0, 1):
        return "traceback"
    known = before if code == 0 else after
    return "right" if same == known.read_bytes() else "another map"


def _damaged(data: bytes, rng: random.Random) -> bytes:
    """Return bytes with some changed, removed, repeated or zero."""
    changed, kind = bytearray(data), rng.randrange(4)
    at = rng.randrange(len(changed)) if rng.random() < 0.5 else rng.randrange(100)
    if kind == 0:
        for _ in range(rng.choice((1, 1, 8, 64))):
            changed[rng.randrange(len(changed))] = rng.randrange(256)
        changed[at] = rng.randrange(256)
    elif kind == 1:
        del changed[at:]
    elif kind == 2:
        changed[at : at + 4096] = bytes(len(changed[at : at + 4096]))
    else:
        del changed[at : at + rng.randrange(1, 5000)]
    return bytes(changed)
