"""The checks after the belief: their order, and what explains them."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

from built_room import unseen_views
from tiny_world import CAMERA
from topoloc.localization.decision import CHECKS, check_threshold
from topoloc.localization.localizer import Localizer
from topoloc.localization.map_query import MapQuery
from topoloc.localization.query import Deadline, QueryImage, StageClock
from topoloc.localization.search import Trace
from topoloc.mapping.topomap import TopoMetricMap

ROOT = Path(__file__).parents[2]


def test_the_table_of_the_architecture_lists_the_checks_in_order():
    page = (ROOT / "docs" / "architecture.md").read_text(encoding="utf-8")
    rows = re.findall(r"^\| `(\w+)` \| `([\w/]+)\.py` \| [^|]+\| [^|]*\|$", page, re.M)
    modules = [(name, f"topoloc.{file.replace('/', '.')}") for name, file in rows]
    assert modules == [(check.__name__, check.__module__) for check in CHECKS]


def test_the_trace_collects_the_findings_of_an_answer(room_map: Path):
    trace = Trace()
    with TopoMetricMap.load(room_map) as topomap:
        result = Localizer(topomap).localize(unseen_views()[0][0], CAMERA, trace=trace)
    assert result.localized
    names = [finding.check for finding in trace.findings]
    assert names[:2] == ["camera", "exact pose"]
    assert all(finding.text for finding in trace.findings)


def test_pixels_of_a_door_alone_leave_its_copies_possible(room_map: Path):
    with TopoMetricMap.load(room_map) as topomap:
        context = Localizer(topomap).context
        image = QueryImage(unseen_views()[0][0], CAMERA)
        query = MapQuery(context, context.searches(image, StageClock(), Deadline()))
        answer = query.search_all()
        best, pose = answer.best, answer.pose
        assert best is not None
        assert pose is not None
        assert pose.probability > 0.98
        assert check_threshold(query, answer) is None
        narrow = replace(best, evidence=replace(best.evidence, spread=0.1, doubt=0.1))
        limited = replace(answer, best=narrow)
        assert limited.after(check_threshold(query, limited)).pose.probability < 0.91
