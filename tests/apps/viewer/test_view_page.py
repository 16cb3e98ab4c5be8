"""Test `topoloc view`: the page works from a file, in a real browser, wide and narrow, light and
dark, by mouse and by keyboard."""

from __future__ import annotations

import json
import tempfile
import webbrowser
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from in_browser import CONTRASTS, UNNAMED, WIDTHS, chromium, opened
from topoloc.apps.cli import main
from topoloc.apps.viewer import page as viewer_page
from topoloc.geometry.rigid import Rigid3, exp_so3
from topoloc.localization.result import Alternative, Localization, NotLocalized

VIEWER = "document.querySelector('[data-scene]').viewer"
COVARIANCE = np.diag([0.04, 0.01, 0.0025, 0.02, 0.01, 0.04])


@dataclass(frozen=True)
class Shown:
    """Hold a page of the room and the poses of its results. One result is off by 5 cm,
    another is ambiguous."""

    page: Path
    found: Rigid3
    true: Rigid3
    others: list[Rigid3]


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    with chromium() as browser:
        yield browser


@pytest.fixture(scope="module")
def shown(room_map: Path, tmp_path_factory: pytest.TempPathFactory) -> Shown:
    folder = tmp_path_factory.mktemp("view")
    found = Rigid3(exp_so3(np.array([0.1, 0.2, 0.3])), np.array([0.5, 0.1, 0.4]))
    true = Rigid3(found.rotation, found.translation + np.array([0.0, 0.03, 0.04]))
    others = [found, Rigid3(found.rotation, found.translation + np.array([1.0, 0.0, 0.0]))]
    answer = Localization(found, COVARIANCE, 0.97, 0, [], 50, 40, {"total": 12.0}).to_json(
        "off.png"
    )
    unclear = NotLocalized(
        "ambiguous", alternatives=tuple(Alternative(pose, 0.4, 0) for pose in others)
    ).to_json("twice.png")
    truth = {"translation": true.translation.tolist(), "quat_wxyz": true.quat_wxyz().tolist()}
    answers = [
        answer | {"recording": "walk", "true_world_from_cam": truth},
        unclear | {"recording": "walk", "true_world_from_cam": truth},
    ]
    (folder / "evaluation.json").write_text(json.dumps({"answers": answers}))
    assert (
        main(
            [
                "view",
                str(room_map),
                str(folder / "evaluation.json"),
                "--out",
                str(folder / "room.html"),
            ]
        )
        == 0
    )
    return Shown(folder / "room.html", found, true, others)


def _centres(page: Any, kind: str) -> np.ndarray:
    """Return the centres of the frustums of this kind: the vertex that all lines from
    a centre share."""
    found = page.evaluate(
        f"""() => {{ const all = []; {VIEWER}.chosen.traverse((one) => {{
        if (one.userData.kind === "{kind}") all.push([...one.geometry.attributes.position.array.slice(0, 3)]); }}); return all; }}"""  # noqa: E501
    )
    return np.array(found).reshape(-1, 3)


@pytest.mark.parametrize("width", WIDTHS)
def test_an_answer_that_is_chosen_is_shown_with_its_ellipsoid_and_the_truth(
    browser: Any, shown: Shown, width: int
):
    with opened(browser, shown.page.as_uri(), width) as page:
        page.get_by_label("Go to").select_option("off.png")
        assert np.linalg.norm(_centres(page, "answer") - shown.found.translation) < 1e-5
        assert np.linalg.norm(_centres(page, "truth") - shown.true.translation) < 1e-5
        said = page.inner_text("[data-part=details]")
        assert "Error: 5.0 cm" in said
        assert "probability 0.97" in said
        page.get_by_label("Go to").select_option("twice.png (not localized)")
        centres = _centres(page, "alternative")
        np.testing.assert_allclose(centres, [pose.translation for pose in shown.others], atol=1e-5)
        assert "Several similar places" in page.inner_text("[data-part=details]")


def test_the_ellipsoid_is_that_of_the_cameras_own_position(browser: Any, shown: Shown):
    skew = np.array([[0.0, 0.4, -0.1], [-0.4, 0.0, 0.5], [0.1, -0.5, 0.0]])  # of -(0.5, 0.1, 0.4)
    jacobian = np.hstack([np.eye(3), skew])
    expected = 7.8147 * jacobian @ COVARIANCE @ jacobian.T
    with opened(browser, shown.page.as_uri(), 1300) as page:
        page.get_by_label("Go to").select_option("off.png")
        ellipsoids = page.evaluate(f"""() => {{ const all = []; {VIEWER}.chosen.traverse((one) => {{
            if (!one.isMesh || one.geometry.type !== "SphereGeometry") return;
            one.updateWorldMatrix(true, false);  // else it is made when the next picture is drawn
            all.push(one.matrixWorld.elements); }}); return all; }}""")
    (matrix,) = (np.array(elements).reshape(4, 4).T for elements in ellipsoids)
    np.testing.assert_allclose(matrix[:3, :3] @ matrix[:3, :3].T, expected, rtol=1e-3, atol=1e-6)
    np.testing.assert_allclose(matrix[:3, 3], shown.found.translation, atol=1e-6)


@pytest.mark.parametrize("dark", [False, True], ids=["light", "dark"])
@pytest.mark.parametrize("width", WIDTHS)
def test_it_fits_can_be_read_and_named(browser: Any, shown: Shown, width: int, dark: bool):
    with opened(browser, shown.page.as_uri(), width, dark) as page:
        page.wait_for_function(f"{VIEWER} !== undefined")
        assert page.evaluate("document.documentElement.scrollWidth") <= width
        assert page.evaluate(UNNAMED) == []
        lowest = page.evaluate(CONTRASTS)[0]
        assert lowest[0] >= 4.5, lowest
        picture = cv2.imdecode(
            np.frombuffer(page.locator("canvas").screenshot(), np.uint8), cv2.IMREAD_COLOR
        )
        ground = picture.reshape(-1, 3)[picture.shape[1] // 2]
        assert (np.abs(picture.astype(int) - ground).max(axis=2) > 40).mean() > 0.005, (
            "something is drawn"
        )
        assert (ground.mean() < 60) == dark


def test_it_is_worked_by_keyboard(browser: Any, shown: Shown):
    eye = f"{VIEWER}.stage.camera.position.toArray()"
    with opened(browser, shown.page.as_uri(), 1300) as page:
        page.locator("canvas").focus()
        first = page.evaluate(eye)
        for key in ("ArrowLeft", "ArrowUp", "Shift+ArrowRight", "+"):
            before = page.evaluate(eye)
            page.keyboard.press(key)
            assert np.linalg.norm(np.subtract(page.evaluate(eye), before)) > 1e-3, key
        page.keyboard.press("Home")
        np.testing.assert_allclose(page.evaluate(eye), first, atol=1e-6)
        page.keyboard.press("n")
        assert page.inner_text("[data-part=details] h3") == "off.png"
        page.locator("body").press("Tab")
        assert page.evaluate("document.activeElement.tagName") != "BODY"


def test_the_bar_and_the_axes_are_those_of_the_view(browser: Any, shown: Shown):
    with opened(browser, shown.page.as_uri(), 1300) as page:
        page.evaluate(f"{VIEWER}.stage.turn(0.4, 0.1)")
        lengths = set[str]()
        for _ in range(3):
            page.evaluate(f"{VIEWER}.stage.zoom(0.5)")
            page.wait_for_timeout(300)
            bar = page.locator("[data-part=scale]")
            value, unit = bar.inner_text().split()
            lengths.add(f"{value} {unit}")
            metres = float(value) * {"m": 1.0, "cm": 0.01}[unit]
            box = bar.bounding_box()
            assert box is not None
            start, *ends, aside = page.evaluate(f"""() => {{
                const {{ stage }} = {VIEWER}, middle = stage.controls.target, moved = (way) => stage.seen(middle.clone().add(way));
                const [x, y, z] = [0, 1, 2].map((k) => middle.clone().set(...[0, 1, 2].map((i) => (i === k ? 1e-3 : 0))));
                const right = middle.clone().setFromMatrixColumn(stage.camera.matrixWorld, 0).multiplyScalar({metres});
                return [stage.seen(middle), moved(x), moved(y), moved(z), moved(right)]; }}""")  # noqa: E501
            assert box["width"] == pytest.approx(aside[0] - start[0], abs=1.5)
            for label, end in zip("xyz", ends, strict=True):
                arm = page.locator("[data-part=axes] g", has_text=label).locator("line")
                drawn = [float(arm.get_attribute(name) or "0") for name in ("x2", "y2")]
                way = np.subtract(end, start)
                np.testing.assert_allclose(drawn, 24 * way / _pixels(page, 1e-3), atol=0.3)
        assert len(lengths) == 3, "it goes with the zoom"


def _pixels(page: Any, metres: float) -> float:
    return metres / page.evaluate(f"{VIEWER}.stage.metresPerPixel()")


def test_two_clicks_measure_a_distance(browser: Any, shown: Shown):
    with opened(browser, shown.page.as_uri(), 1300) as page:
        said = page.locator("[data-part=measured]")
        assert said.is_hidden()
        page.get_by_role("button", name="Measure").click()
        nodes = page.evaluate(
            f"{VIEWER}.document.nodes.map((one) => one.world_from_cam.translation)"
        )
        ends = [nodes[0], nodes[-1]]
        for end in ends:
            page.mouse.click(*page.evaluate(f"(end) => {VIEWER}.stage.seen(end)", end))
        distance = np.linalg.norm(np.subtract(*ends))
        assert said.inner_text().startswith(f"{distance:.3f} m (x ")
        assert page.evaluate(f"{VIEWER}.measure.drawn.children.length") == 1
        page.mouse.click(5, 790)
        assert said.inner_text() == "There is no point of the map. Click on one."
        page.locator("canvas").press("Escape")
        assert said.is_hidden()
        assert page.evaluate(f"{VIEWER}.measure.drawn.children.length") == 0


def test_a_point_in_front_is_measured(browser: Any, shown: Shown):
    """A click measures the visible point, not a point of the wall behind it."""
    with opened(browser, shown.page.as_uri(), 1300) as page:
        page.get_by_role("button", name="Measure").click()
        points, seen, depths, nodes = page.evaluate(f"""() => {{
            const viewer = {VIEWER}, {{ stage }} = viewer, flat = [...viewer.cloud.geometry.attributes.position.array];
            const points = flat.flatMap((_, i) => (i % 3 ? [] : [flat.slice(i, i + 3)]));
            const depth = (point) => -stage.controls.target.clone().set(...point).applyMatrix4(stage.camera.matrixWorldInverse).z;
            return [points, points.map((point) => stage.seen(point)), points.map(depth), viewer.places.map(({{ centre }}) => stage.seen(centre))]; }}""")  # noqa: E501
        points, seen, depths = np.array(points), np.array(seen), np.array(depths)
        away = np.linalg.norm(seen[:, None] - np.array(nodes), axis=2).min(axis=1)
        inside = (away > 30) & (seen > [20, 120]).all(axis=1) & (seen < [900, 690]).all(axis=1)
        tried = 0
        for row in np.flatnonzero(inside)[::97]:
            near = np.flatnonzero(np.linalg.norm(seen - seen[row], axis=1) < 5.9)
            front = near[np.argmin(depths[near])]
            at_edge = np.linalg.norm(seen - seen[row], axis=1)
            if len(near) < 2 or ((at_edge > 5.9) & (at_edge < 6.9)).any():
                continue
            found = page.evaluate(
                "([x, y]) => " + f"{VIEWER}.measure.nearest(x, y)", seen[row].tolist()
            )
            np.testing.assert_allclose(found, points[front], atol=1e-6)
            tried += 1
        assert tried >= 3


def test_a_layer_goes_and_comes(browser: Any, shown: Shown):
    with opened(browser, shown.page.as_uri(), 1300) as page:
        before = page.locator("canvas").screenshot()
        box = page.locator("label", has_text="points").get_by_role("checkbox")
        size = box.bounding_box()
        assert min(size["width"], size["height"]) >= 24
        box.uncheck()
        page.wait_for_timeout(200)
        assert page.locator("canvas").screenshot() != before
        page.get_by_label("their images").check()
        page.wait_for_function(
            f"{VIEWER}.stage.scene.children.some((one) => one.children.some((two) =>"
            " two.material?.map?.image))"
        )


def test_a_picture_of_the_page(
    shown: Shown, room_map: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    try:
        viewer_page.find_browser()
    except viewer_page.TopolocError as error:
        pytest.skip(str(error))
    assert main(["view", str(room_map), "--screenshot", str(tmp_path / "room.png")]) == 0
    assert "room.png" in capsys.readouterr().out
    picture = cv2.imread(str(tmp_path / "room.png"))
    assert picture is not None
    assert picture[:, :900].std() > 5
    assert [path.name for path in tmp_path.iterdir()] == ["room.png"]


def test_no_browser_is_one_line(
    room_map: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, complaint: Callable[..., str]
):
    monkeypatch.setenv("PATH", str(tmp_path))
    assert "chromium" in complaint("view", room_map, "--screenshot", tmp_path / "room.png")


def test_bad_input_is_one_line(room_map: Path, tmp_path: Path, complaint: Callable[..., str]):
    (tmp_path / "bad.jsonl").write_text('{"query": "a"}\n')
    assert "bad.jsonl" in complaint(
        "view", room_map, tmp_path / "bad.jsonl", "--out", tmp_path / "x.html"
    )
    assert "No such file" in complaint("view", tmp_path / "none.topo", "--out", tmp_path / "x.html")
    assert "--points" in complaint(
        "view", room_map, "--points", -1, "--out", tmp_path / "x.html", status=2
    )


def test_without_an_output_the_browser_opens(
    room_map: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    opened_pages = list[str]()
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    monkeypatch.setattr(webbrowser, "open", lambda address: opened_pages.append(address) or True)
    assert main(["view", str(room_map)]) == 0
    (page,) = tmp_path.rglob("*.html")
    assert opened_pages == [page.as_uri()]
    assert main(["view", str(room_map), "--json", str(tmp_path / "scene.json")]) == 0
    assert len(opened_pages) == 1
    assert json.loads((tmp_path / "scene.json").read_text())["format"] == "topoloc-scene"


def test_results_of_another_map_are_reported(
    room_map: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    other = Localization(Rigid3.identity(), COVARIANCE, 0.9, 0, [], 5, 5).to_json("a") | {
        "map": "0123456789abcdef"
    }
    (tmp_path / "r.jsonl").write_text(json.dumps(other) + "\n")
    assert (
        main(["view", str(room_map), str(tmp_path / "r.jsonl"), "--out", str(tmp_path / "x.html")])
        == 0
    )
    assert "warning: some answers are of another map (0123456789abcdef" in capsys.readouterr().err
