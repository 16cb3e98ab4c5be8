"""Test stored stages: reused without a change, and computed again after a change or a loss."""

from __future__ import annotations

from pathlib import Path

import pytest

from topoloc.errors import TopolocError
from topoloc_paper.stage_code import StageCode
from topoloc_paper.stages import StageStore

RIGID = StageCode(("topoloc/geometry/rigid.py",))


class Counter:
    def __init__(self) -> None:
        self.calls = 0

    def __call__(self) -> dict[str, int]:
        self.calls += 1
        return {"calls": self.calls}


def test_a_stage_is_done_once_and_found_by_the_next_run(tmp_path: Path):
    work = Counter()
    first = StageStore(tmp_path).get("map", {"d_thresh": 2.0}, work, RIGID)
    again = StageStore(tmp_path).get("map", {"d_thresh": 2.0}, work, RIGID)
    assert work.calls == 1
    assert first == again


@pytest.mark.parametrize(
    ("settings", "code"),
    [({"d_thresh": 1.0}, RIGID), ({"d_thresh": 2.0}, StageCode(("topoloc/features/sift.py",)))],
)
def test_other_settings_or_other_code_are_another_result(
    tmp_path: Path, settings: dict[str, float], code: StageCode
):
    work = Counter()
    store = StageStore(tmp_path)
    first = store.get("map", {"d_thresh": 2.0}, work, RIGID)
    other = store.get("map", settings, work, code)
    assert other.result == {"calls": 2}
    assert other.digest != first.digest


def test_a_lost_file_or_a_damaged_stage_is_made_again(tmp_path: Path):
    work, file = Counter(), tmp_path / "map.topo"
    store = StageStore(tmp_path / "stages")

    def write() -> dict[str, int]:
        file.write_text("map")
        return work()

    store.get("map", {}, write, RIGID, files=[file])
    store.get("map", {}, write, RIGID, files=[file])
    assert work.calls == 1
    file.unlink()
    store.get("map", {}, write, RIGID, files=[file])
    (tmp_path / "stages" / "map.json").write_text('{"origin": ')
    store.get("map", {}, write, RIGID, files=[file])
    assert work.calls == 3
    assert (store.num_done, store.num_kept) == (3, 1)


def test_a_stage_that_fails_leaves_nothing(tmp_path: Path):
    store = StageStore(tmp_path)

    def fail() -> None:
        raise TopolocError("no")

    with pytest.raises(TopolocError):
        store.get("map", {}, fail, RIGID)
    assert list(tmp_path.iterdir()) == []
