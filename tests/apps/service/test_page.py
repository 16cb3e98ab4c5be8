"""Test the page at `/` in a real browser. An image of the demo's world is dropped, pasted or
chosen. Its result is listed, saved and linked."""

from __future__ import annotations

import base64
import json
import shutil
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from running_service import TOKEN, Running, running

from in_browser import CONTRASTS, UNNAMED, WIDTHS, chromium, opened
from topoloc.apps.cli import main
from topoloc.demo.recordings import SHIPPED, find_missing_recordings
from topoloc.geometry.rigid import Rigid3
from topoloc.localization.map_facts.map_building import build_map
from topoloc.mapping.build import BuildConfig
from topoloc.recordings.open import open_sequence

pytestmark = pytest.mark.skipif(
    bool(find_missing_recordings(SHIPPED)), reason="the demo's recordings are not in this checkout"
)
NOTHING = SHIPPED / "pictures_of_nothing" / "black.png"
ANSWERED = "#answer h2.good, #answer h2.bad"
# Drop an image on the page, or paste it.
BROUGHT = """([how, name, base64]) => {
  const bytes = Uint8Array.from(atob(base64), (letter) => letter.charCodeAt(0));
  const data = new DataTransfer();
  data.items.add(new File([bytes], name, { type: "image/jpeg" }));
  const dropped = new DragEvent("drop", { dataTransfer: data, bubbles: true });
  const pasted = new ClipboardEvent("paste", { clipboardData: data, bubbles: true });
  document.getElementById("drop").dispatchEvent(how === "drop" ? dropped : pasted);
}"""


@dataclass(frozen=True)
class Lab:
    """Hold a service of a map of the demo's first frames and its copy `room`, and an image
    of another lap."""

    service: Running
    map: Path
    picture: Path
    camera: str
    true: Rigid3


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    with chromium() as browser:
        yield browser


@pytest.fixture(scope="module")
def lab(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Lab]:
    folder = tmp_path_factory.mktemp("lab")
    build_map(open_sequence(f"{SHIPPED / 'map_lap1'}@4:10"), BuildConfig(other_kinds=())).save(
        folder / "lab.topo"
    )
    shutil.copy(folder / "lab.topo", folder / "room.topo")
    day = open_sequence(SHIPPED / "day")
    camera, pose = day[4].camera, day.poses[4]
    assert camera is not None
    assert pose is not None
    numbers = f"{camera.fx}, {camera.fy}, {camera.cx}, {camera.cy}"
    with running(folder, "--workers", 1) as service:
        yield Lab(service, folder / "lab.topo", SHIPPED / "day" / day.names[4], numbers, pose)


def _bring(page: Any, lab: Lab, how: str) -> None:
    """Add the image with its calibration to the page in this way, and wait for the result."""
    page.wait_for_selector("#scene canvas")
    page.locator("#camera-field summary").click()
    page.get_by_label("fx, fy, cx, cy in pixels").last.fill(lab.camera)
    if how == "choose":
        page.set_input_files("#file", lab.picture)
    else:
        page.evaluate(
            BROUGHT, [how, lab.picture.name, base64.b64encode(lab.picture.read_bytes()).decode()]
        )
    page.wait_for_selector(ANSWERED, timeout=60_000)


def _frustum(page: Any) -> np.ndarray:
    """Return the centre of the drawn camera in metres."""
    centres = page.evaluate(
        """() => { const all = []; document.getElementById("scene").viewer.chosen.traverse((one) => {
        if (one.userData.kind === "answer") all.push([...one.geometry.attributes.position.array.slice(0, 3)]); }); return all; }"""  # noqa: E501
    )
    assert len(centres) == 1
    return np.array(centres[0])


@pytest.mark.parametrize(("how", "width"), [("drop", 1300), ("paste", 400), ("choose", 400)])
def test_an_image_shows_its_pose(browser: Any, lab: Lab, how: str, width: int):
    with opened(browser, f"{lab.service.url}/", width) as page:
        _bring(page, lab, how)
        assert np.linalg.norm(_frustum(page) - lab.true.translation) < 0.01
        said = page.inner_text("#answer")
        assert "Here, at" in said
        assert "Standard deviation" in said
        assert "It took" in said
        page.wait_for_selector("#matches:not([hidden])", timeout=60_000)
        assert "matches agree on a pose" in page.inner_text("#matches figcaption")
        assert page.evaluate("document.documentElement.scrollWidth") <= width


@pytest.mark.parametrize("dark", [False, True], ids=["light", "dark"])
@pytest.mark.parametrize("width", WIDTHS)
def test_it_can_be_read_and_named(browser: Any, lab: Lab, width: int, dark: bool):
    with opened(browser, f"{lab.service.url}/", width, dark) as page:
        page.wait_for_selector("#scene canvas")
        page.locator("#camera-field summary").click()
        lowest = page.evaluate(CONTRASTS)[0]
        assert lowest[0] >= 4.5, lowest
        assert page.evaluate(UNNAMED) == []


def test_a_picture_of_nothing_is_refused_with_advice(browser: Any, lab: Lab):
    with opened(browser, f"{lab.service.url}/", 1300) as page:
        page.wait_for_selector("#scene canvas")
        page.set_input_files("#file", NOTHING)
        page.wait_for_selector("#answer h2.bad", timeout=60_000)
        assert page.inner_text("#answer h2").startswith("Not localized.")
        page.wait_for_selector("#why li", timeout=60_000)


def test_a_map_that_is_not_there_is_named_beside_those_that_are(browser: Any, lab: Lab):
    with opened(browser, f"{lab.service.url}/?map=wrong", 400) as page:
        page.wait_for_selector("#answer h2.bad")
        assert page.inner_text("#answer") == 'No map "wrong". Maps here: lab, room'
        assert page.locator("#scene canvas").count() == 0
        page.locator("#answer").get_by_role("link", name="room").click()
        page.wait_for_selector("#scene canvas")
        assert page.url == f"{lab.service.url}/?map=room"
        assert page.locator("#map").input_value() == "room"
        assert page.inner_text("[data-part=details] h3") == "room"


def test_the_selector_sets_the_map_in_the_address(browser: Any, lab: Lab):
    with opened(browser, f"{lab.service.url}/", 1300) as page:
        page.locator("[data-part=details]").get_by_text("lab", exact=True).wait_for()
        page.locator("#map").select_option("room")
        page.locator("[data-part=details]").get_by_text("room", exact=True).wait_for()
        assert page.url == f"{lab.service.url}/?map=room"
        page.go_back()
        page.locator("[data-part=details]").get_by_text("lab", exact=True).wait_for()
        assert page.locator("#map").input_value() == "lab"
        for name in ["room", "lab"] * 9:  # Chromium warns of more than 16 WebGL contexts
            page.locator("#map").select_option(name)
            page.locator("[data-part=details]").get_by_text(name, exact=True).wait_for()


def test_answers_stay_in_a_list_that_can_be_saved(
    browser: Any, lab: Lab, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    with opened(browser, f"{lab.service.url}/", 1300) as page:
        _bring(page, lab, "choose")
        page.wait_for_selector("#matches:not([hidden])", timeout=60_000)
        page.set_input_files("#file", NOTHING)
        page.wait_for_selector("#why li", timeout=60_000)
        rows = page.locator("#answers li")
        last, first = rows.all_inner_texts()
        assert last.split("\n") == ["black.png", "too few matches"]
        assert first.startswith(f"{lab.picture.name}\nlocalized, p ")
        assert "σ " in first
        rows.last.get_by_role("button").click()
        assert np.linalg.norm(_frustum(page) - lab.true.translation) < 0.01
        assert page.inner_text("#answer h2").startswith("Here, at")
        page.wait_for_selector("#matches:not([hidden])")
        assert page.locator("#why").is_hidden()
        saved = [tmp_path / "saved.jsonl", tmp_path / "saved.tum"]
        for path, button in zip(saved, ("Save JSON", "Save TUM"), strict=True):
            with page.expect_download() as download:
                page.get_by_role("button", name=button).click()
            download.value.save_as(path)
        page.set_viewport_size({"width": 400, "height": 800})
        assert page.evaluate("document.documentElement.scrollWidth") <= 400
        assert page.evaluate(UNNAMED) == []
        assert page.evaluate(CONTRASTS)[0][0] >= 4.5
        page.locator("#map").select_option("room")
        assert page.locator("#answers").is_hidden(), "these answers are of the other map"
    lines = [json.loads(line) for line in saved[0].read_text().splitlines()]
    assert [line["query"] for line in lines] == [lab.picture.name, "black.png"]
    poses = [line for line in saved[1].read_text().splitlines() if not line.startswith("#")]
    assert len(poses) == 1
    np.testing.assert_allclose(
        [float(number) for number in poses[0].split()[1:4]],
        lines[0]["world_from_cam"]["translation"],
    )
    out = str(tmp_path / "lab.html")
    assert main(["view", str(lab.map), *map(str, saved), "--out", out]) == 0
    output = capsys.readouterr()
    assert "2 answers" in output.out
    assert output.err == ""


def test_a_link_draws_its_answer_again(browser: Any, lab: Lab):
    with opened(browser, f"{lab.service.url}/", 1300) as page:
        page.context.grant_permissions(["clipboard-read", "clipboard-write"])
        _bring(page, lab, "choose")
        page.get_by_role("button", name="Copy link").click()
        page.get_by_role("button", name="Link copied").wait_for()
        link, drawn = page.evaluate("navigator.clipboard.readText()"), _frustum(page)
    with opened(browser, link, 400) as page:
        page.get_by_role("heading", name=f"Linked answer: {lab.picture.name}").wait_for()
        np.testing.assert_allclose(_frustum(page), drawn, atol=1e-6)
        said = page.inner_text("#answer")
        assert "The link holds this pose." in said
        assert "another map" not in said
        page.goto(link.replace("of=", "of=0"))
        page.get_by_text("The link is of another map").wait_for()
        page.set_input_files("#file", NOTHING)
        page.wait_for_selector("#answer h2.bad", timeout=60_000)
        assert "#" not in page.url, "what is shown is no longer what the link holds"
        page.goto(link.replace("pose=", "pose=x"))
        page.get_by_text('The link is damaged: "pose" needs 7 numbers.').wait_for()


def test_without_webgl_the_answer_is_in_words(browser: Any, lab: Lab):
    page = browser.new_page()
    page.add_init_script("""const first = HTMLCanvasElement.prototype.getContext;
        HTMLCanvasElement.prototype.getContext = function (kind, ...rest) {
          return kind === "2d" ? first.call(this, kind, ...rest) : null; };""")
    page.goto(lab.service.url)
    page.get_by_text("This browser shows no 3-D").wait_for()
    _bring(page, lab, "choose")
    assert page.inner_text("#answer h2").startswith("Here, at")
    page.wait_for_timeout(500)  # an error would follow at once
    assert page.inner_text("#answer h2").startswith("Here, at")
    page.close()


def test_it_is_worked_by_keyboard(browser: Any, lab: Lab):
    with opened(browser, f"{lab.service.url}/", 1300) as page:
        page.wait_for_selector("#scene canvas")
        reached = set[str]()
        for _ in range(30):
            page.keyboard.press("Tab")
            reached.add(
                page.evaluate(
                    "document.activeElement.id || document.activeElement.dataset.part ||"
                    " document.activeElement.tagName"
                )
            )
        assert {"choose", "live", "SUMMARY", "canvas", "home", "list"} <= reached
        with page.expect_file_chooser():
            page.locator("#choose").focus()
            page.keyboard.press("Enter")


def test_a_live_stream_draws_the_path(lab: Lab, browser: Any):
    """A canvas with the image replaces the browser's camera. A corner of it changes, as no image of
    a camera equals the one before."""
    with opened(browser, f"{lab.service.url}/", 1300) as page:
        page.wait_for_selector("#scene canvas")
        page.evaluate(
            """async (base64) => {
              const image = new Image();
              image.src = `data:image/jpeg;base64,${base64}`;
              await image.decode();
              const canvas = Object.assign(document.createElement("canvas"), { width: image.width, height: image.height });
              const context = canvas.getContext("2d");
              setInterval(() => {
                context.drawImage(image, 0, 0);
                context.fillStyle = `rgb(${Date.now() % 256}, 0, 0)`;
                context.fillRect(0, 0, 8, 8);
              }, 50);
              navigator.mediaDevices.getUserMedia = async () => canvas.captureStream(20);
            }""",  # noqa: E501
            base64.b64encode(lab.picture.read_bytes()).decode(),
        )
        page.locator("#camera-field summary").click()
        page.get_by_label("fx, fy, cx, cy in pixels").last.fill(lab.camera)
        page.get_by_text("Live camera").click()
        track = (
            "document.getElementById('scene').viewer.live.children.flatMap((group) =>"
            " group.children).length"
        )
        for _ in range(300):  # `wait_for_function` would be barred by the page's policy
            if page.evaluate(track) > 0:
                break
            page.wait_for_timeout(100)
        assert page.evaluate(track) > 0, page.inner_text("#answer")
        assert "State of the stream" in page.inner_text("#answer")
        assert np.linalg.norm(_frustum(page) - lab.true.translation) < 0.02
        page.get_by_role("button", name="Explain").click()
        page.wait_for_selector("#matches:not([hidden])", timeout=60_000)
        assert page.locator("#view").is_hidden()
        assert page.inner_text("#answer h2").startswith("Here, at")


def test_the_token_is_requested(room_map: Path, tmp_path: Path, browser: Any):
    (tmp_path / "token").write_text(TOKEN)
    with running(room_map, "--token-file", tmp_path / "token") as service:
        page = browser.new_page()
        page.goto(f"{service.url}/")
        page.get_by_text("The map is shown once the token is entered.").wait_for()
        page.get_by_label("This service needs a token").fill("wrong-token-of-some-length")
        page.keyboard.press("Enter")
        page.wait_for_selector("#answer h2.bad")
        page.get_by_label("This service needs a token").fill(TOKEN)
        page.keyboard.press("Enter")
        page.wait_for_selector("#scene canvas")
        assert page.locator("#token-field").is_hidden()
        page.close()


def test_files_beside_the_page_are_not_given_out(lab: Lab):
    with lab.service.client() as client:
        assert client.get("/static/three.js").headers["content-type"].startswith("text/javascript")
        assert "MIT" in client.get("/static/three.LICENSE").text
        for name in ("../document.py", "%2e%2e/document.py", "page", "page/", "", "nothing.js"):
            assert client.get(f"/static/{name}").status_code == 404, name
        assert "default-src 'none'" in client.get("/").headers["content-security-policy"]


def test_the_scene_is_that_of_the_file_that_is_there_now(room_map: Path, lab: Lab, tmp_path: Path):
    (tmp_path / "a.topo").write_bytes(room_map.read_bytes())
    with running(tmp_path) as service, service.client() as client:
        before = client.get("/v1/maps/a/scene").json()
        assert before == client.get("/v1/maps/a/scene").json()
        build_map(open_sequence(f"{SHIPPED / 'map_lap1'}@4:6"), BuildConfig(other_kinds=())).save(
            tmp_path / "a.topo"
        )
        assert client.get("/v1/maps/a/scene").json()["map"]["id"] != before["map"]["id"]
        assert client.get("/v1/maps/b/scene").status_code == 404


def test_a_map_that_grows_is_drawn_again_seen_as_before(browser: Any, lab: Lab):
    """`topoloc map` replaces the displayed file by one with more nodes."""
    growing = lab.map.with_name("growing.topo")
    view = """() => { const { camera, controls } = document.getElementById("scene").viewer.stage;
        return [...camera.position.toArray(), ...controls.target.toArray()]; }"""
    nodes = "() => document.getElementById('scene').viewer?.document.nodes.length"
    shutil.copy(lab.map, growing)
    more = build_map(open_sequence(f"{SHIPPED / 'map_lap1'}@4:14"), BuildConfig(other_kinds=()))
    with opened(browser, f"{lab.service.url}/?map=growing", 1300) as page:
        page.wait_for_selector("#scene canvas")
        before = page.evaluate(nodes)
        page.keyboard.press("Tab")
        page.locator("#scene canvas").press("ArrowLeft")
        seen_from = page.evaluate(view)
        page.wait_for_timeout(3500)  # the page has polled once
        more.save(growing)
        for _ in range(200):
            if page.evaluate(nodes) != before:
                break
            page.wait_for_timeout(100)
        assert page.evaluate(nodes) == len(more.summaries)
        np.testing.assert_allclose(page.evaluate(view), seen_from, atol=1e-4)
    growing.unlink()
