"""Test the page as a phone uses it, in a real browser whose camera shows the demo's recording. The
map overlay lies at the true pixels, notes are shared, and missing device features are reported."""

from __future__ import annotations

import base64
import json
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from running_service import Running, running

from in_browser import CONTRASTS, UNNAMED, chromium
from topoloc.demo.recordings import SHIPPED, find_missing_recordings
from topoloc.geometry.camera import Camera
from topoloc.geometry.rigid import Rigid3
from topoloc.localization.map_facts.map_building import build_map
from topoloc.mapping.build import BuildConfig
from topoloc.recordings.frame import StereoSequence
from topoloc.recordings.image_io import EncodedImage, read_image
from topoloc.recordings.open import open_sequence

pytestmark = pytest.mark.skipif(
    bool(find_missing_recordings(SHIPPED)), reason="the demo's recordings are not in this checkout"
)
FRAMES = (3, 4, 5)
SIGHT = "document.querySelector('[data-part=sight]').sight"
# The overlay: the image of the last result, its place on the canvas, and points with pixels.
DRAWN = f"""() => {{
  const sight = {SIGHT};
  if (!sight.seen) return null;
  sight.draw();
  const {{ canvas }} = sight.seen.picture;
  return {{ image: canvas.toDataURL("image/png"), placed: sight.fitted(canvas.width, canvas.height),
    drawn: sight.drawn.map(([point, at]) => [...point, ...at]) }};
}}"""
NO_SOCKET = (
    "WebSocket = class { constructor() { setTimeout(() => this.onclose({}), 50); } close() {} };"
)
REFUSED = """navigator.mediaDevices.getUserMedia = async () => {
  throw new DOMException("", "NotAllowedError"); };"""
INSECURE = """Object.defineProperty(navigator, "mediaDevices", { value: undefined });"""
IOS_DENIES = "DeviceOrientationEvent.requestPermission = async () => 'denied';"
AWAKE = """Object.defineProperty(navigator, "wakeLock", { value: { request: async (kind) => {
  globalThis.awake = kind; return { release: async () => { globalThis.awake = null; } }; } } });"""


@dataclass(frozen=True)
class Phone:
    """Hold a browser whose camera shows the frames of `walk`, and a service of a map
    of that place."""

    browser: Any
    service: Running
    walk: StereoSequence
    notes: Path


@pytest.fixture(scope="module")
def phone(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Phone]:
    folder = tmp_path_factory.mktemp("lab")
    build_map(open_sequence(f"{SHIPPED / 'map_lap1'}@0:12"), BuildConfig(other_kinds=())).save(
        folder / "lab.topo"
    )
    walk = open_sequence(SHIPPED / "day")
    video = folder / "walk.y4m"
    with video.open("wb") as file:
        file.write(b"YUV4MPEG2 W640 H400 F1:1 Ip A1:1 C420mpeg2\n")
        for i in FRAMES:
            yuv = cv2.cvtColor(walk[i].image, cv2.COLOR_RGB2YUV_I420)
            file.write(b"FRAME\n" + yuv.tobytes())
    options = ("--use-fake-device-for-media-stream", "--use-fake-ui-for-media-stream")
    with (
        running(folder, "--workers", 1) as service,
        chromium(*options, f"--use-file-for-fake-video-capture={video}") as browser,
    ):
        yield Phone(browser, service, walk, folder / "lab.notes.json")


@contextmanager
def live(phone: Phone, script: str = "", size: tuple[int, int] = (400, 800)) -> Iterator[Any]:
    """Open the page with the live camera on, after running this script. Any page error
    fails the test."""
    width, height = size
    page = phone.browser.new_page(viewport={"width": width, "height": height})
    errors = list[str]()
    page.on("pageerror", lambda error: errors.append(str(error)))
    if script:
        page.add_init_script(script)
    page.goto(phone.service.url)
    page.wait_for_selector("#scene canvas")
    page.get_by_role("button", name="Live camera").click()
    yield page
    assert errors == []
    page.close()


def _wait(page: Any, condition: str, seconds: float = 60.0) -> None:
    """Wait until a condition is true. The page's policy forbids `wait_for_function`."""
    for _ in range(int(10 * seconds)):
        if page.evaluate(condition):
            return
        page.wait_for_timeout(100)
    raise AssertionError(f"{condition}; {page.inner_text('body')}")


def _errors(phone: Phone, shown: dict[str, Any]) -> np.ndarray:
    """Return the pixel distance of each drawn point from its true projection."""
    data = base64.b64decode(shown["image"].partition(",")[2])
    image = read_image(EncodedImage("drawn", data))[:, :, :3].astype(float)
    i = min(FRAMES, key=lambda i: float(np.abs(phone.walk[i].image - image).mean()))
    camera, pose = phone.walk[i].camera, phone.walk.poses[i]
    assert camera is not None
    assert pose is not None
    drawn, placed = np.array(shown["drawn"]), shown["placed"]
    at = (drawn[:, 3:5] - [placed["left"], placed["top"]]) / placed["scale"] - 0.5
    true = camera.img_from_cam(pose.inverse().apply(drawn[:, :3]))
    inside = camera.is_in_image(true) & (pose.inverse().apply(drawn[:, :3])[:, 2] > 0)
    return np.linalg.norm(true - at, axis=1)[inside]


@pytest.mark.parametrize("size", [(400, 800), (800, 400), (1300, 800)])
def test_the_map_lies_over_the_image_where_truth_puts_it(phone: Phone, size: tuple[int, int]):
    with live(phone, size=size) as page:
        _wait(page, f"{SIGHT}.seen !== null")
        images = set[str]()
        for _ in range(300):
            shown = page.evaluate(DRAWN)
            if shown and shown["image"] not in images:
                images.add(shown["image"])
                assert "Here to" in page.inner_text("[data-part=seen]")
                errors = _errors(phone, shown)
                assert len(errors) > 300
                assert np.quantile(errors, 0.99) < 3.0
            if len(images) >= 3:
                break
            page.wait_for_timeout(100)
        assert len(images) >= 3, "the camera's images change"
        page.wait_for_timeout(1500)  # longer than a camera shows an image, which is asked once
        assert "Here to" in page.inner_text("[data-part=seen]")
        assert page.evaluate("document.documentElement.scrollWidth") <= size[0]
        assert page.evaluate(UNNAMED) == []
        assert page.evaluate(CONTRASTS)[0][0] >= 4.5
        page.get_by_role("button", name="Close").click()
        assert page.locator("#view").is_hidden()
        assert page.locator("#view video").evaluate("(video) => video.srcObject") is None


def test_requests_carry_the_stream_if_a_websocket_fails(phone: Phone):
    with live(phone, NO_SOCKET) as page, phone.service.client() as client:
        _wait(page, f"{SIGHT}.seen !== null")
        assert "topoloc_streams 1.0" in client.get("/metrics").text
        page.get_by_role("button", name="Close").click()
        page.wait_for_timeout(500)
        assert "topoloc_streams 0.0" in client.get("/metrics").text
    assert any("/pictures" in line and '"status": 200' in line for line in phone.service.log)


def test_a_note_is_placed_by_a_tap_and_shared(phone: Phone):
    with live(phone) as page, live(phone, size=(800, 400)) as other:
        _wait(page, f"{SIGHT}.seen !== null && {SIGHT}.drawn.length > 300")
        places = np.array(page.evaluate(f"{SIGHT}.drawn.map(([, at]) => at)"))[:, :2]
        places = places[(np.abs(places - [200, 400]) < [190, 110]).all(axis=1)]
        gaps = np.linalg.norm(places[:, None] - places, axis=2)
        x, y = places[int((gaps < 12.0).sum(axis=1).argmax())]
        spot = {"x": float(x), "y": float(y)}
        page.locator("[data-part=sight]").click(position=spot)
        page.get_by_label("Text of the note").fill("Fire extinguisher")
        page.get_by_role("button", name="Save", exact=True).click()
        _wait(page, f"{SIGHT}.notes.length === 1")
        _wait(other, f"{SIGHT}.notes[0]?.text === 'Fire extinguisher'")
        [kept] = json.loads(phone.notes.read_text())["notes"]
        points = np.array(page.evaluate(f"[...{SIGHT}.points]")).reshape(-1, 3)
        assert np.linalg.norm(points - kept["position"], axis=1).min() < 0.1
        viewer = "document.getElementById('scene').viewer"
        assert other.evaluate(f"{viewer}.notes.children.length") == 1
        other.get_by_role("button", name="Close").click()
        other.locator("#notes li button").click()
        other.get_by_role("button", name="Delete").click()
        _wait(page, f"{SIGHT}.notes.length === 0")
        assert json.loads(phone.notes.read_text())["notes"] == []


def test_a_tap_where_the_map_has_no_points_is_refused(phone: Phone):
    with live(phone) as page:
        page.locator("[data-part=sight]").click(position={"x": 200, "y": 150})
        page.get_by_text("A note needs a pose.").wait_for()
        _wait(page, f"{SIGHT}.seen !== null")
        page.locator("[data-part=sight]").click(position={"x": 200, "y": 150})
        page.get_by_text("The map has no points there.").wait_for()
        assert page.locator("#note").is_hidden()


def test_the_motion_sensor_turns_the_map_between_answers(phone: Phone):
    with live(phone) as page:
        sensor = page.context.new_cdp_session(page)

        def turn(alpha: float, beta: float) -> None:
            angles = {"alpha": alpha, "beta": beta, "gamma": 0}
            sensor.send("DeviceOrientation.setDeviceOrientationOverride", angles)
            page.wait_for_timeout(300)

        turn(30, 90)
        _wait(page, f"{SIGHT}.isPredicted")
        still = f"{SIGHT}.see = () => {{}}, {SIGHT}.view().rotation"
        before = np.array(page.evaluate(still)).reshape(3, 3)
        start = page.evaluate(f"{SIGHT}.seen.picture.turn")
        assert start is not None
        turn(40, 90)
        left = before.T @ np.array(page.evaluate(f"{SIGHT}.view().rotation")).reshape(3, 3)
        # the camera's axis z turns towards -x, 10 degrees to the left
        aside, ahead = np.sin(np.pi / 18), np.cos(np.pi / 18)
        np.testing.assert_allclose(left[:, 2], [-aside, 0, ahead], atol=0.01)
        turn(30, 100)
        up = before.T @ np.array(page.evaluate(f"{SIGHT}.view().rotation")).reshape(3, 3)
        np.testing.assert_allclose(up[:, 2], [0, -aside, ahead], atol=0.01)


def test_the_motion_sensor_is_read_in_every_position_of_the_screen(phone: Phone):
    """The phone stands upright and faces north: portrait, and rotated by 90
    degrees to each side."""
    page = phone.browser.new_page()
    page.goto(phone.service.url)
    seen = page.evaluate(
        """async () => {
          const { Motion } = await import("topoloc/page/webcam");
          const motion = new Motion();
          return [[0, 90, 0, 0], [90, 0, -90, 90], [-90, 0, 90, 270]].map(([alpha, beta, gamma, angle]) => {
            Object.defineProperty(screen, "orientation", { value: { angle }, configurable: true });
            motion.hear({ alpha, beta, gamma });
            return motion.now();
          });
        }"""  # noqa: E501
    )
    # rows: east, north, up. Columns: right, down, forward
    for one in seen:
        np.testing.assert_allclose(one, [1, 0, 0, 0, 0, 1, 0, -1, 0], atol=1e-9)
    page.close()


@pytest.mark.parametrize(
    ("script", "said"),
    [
        (REFUSED, "The browser does not allow this page to use the camera. Allow it"),
        (INSECURE, "over HTTPS, alone. Start the service with --lan."),
        (IOS_DENIES, "Without the motion sensor, the image stands still"),
    ],
    ids=["no permission", "no HTTPS", "no sensor"],
)
def test_a_missing_device_feature_is_one_sentence(phone: Phone, script: str, said: str):
    with live(phone, script) as page:
        page.get_by_text(said).wait_for()


def test_the_screen_stays_on_while_the_camera_is(phone: Phone):
    with live(phone, AWAKE) as page:
        _wait(page, "globalThis.awake === 'screen'")
        page.get_by_role("button", name="Close").click()
        _wait(page, "globalThis.awake === null")


def test_a_stream_that_breaks_is_taken_up_again(phone: Phone):
    script = """const First = WebSocket; globalThis.opened = [];
      WebSocket = class extends First {
        constructor(...all) { super(...all); opened.push(this); } };"""
    with live(phone, script) as page:
        _wait(page, f"{SIGHT}.seen !== null")
        page.evaluate(f"{SIGHT}.forget(); opened[0].close()")
        _wait(page, f"opened.length === 2 && {SIGHT}.seen !== null")


def test_a_device_that_is_turned_is_followed_on(phone: Phone):
    with live(phone) as page:
        _wait(page, f"{SIGHT}.seen?.lens.width === 640")
        page.evaluate(
            f"""() => {{ const sight = {SIGHT}, {{ webcam }} = sight, take = webcam.picture.bind(webcam);
            webcam.picture = () => {{ const whole = take();
              const canvas = Object.assign(document.createElement("canvas"), {{ width: 400, height: 400 }});
              canvas.getContext("2d").drawImage(whole.canvas, -120, 0);
              const data = atob(canvas.toDataURL("image/jpeg", 0.9).split(",")[1]);
              const file = new File([Uint8Array.from(data, (one) => one.charCodeAt(0))], "turned.jpg");
              return {{ ...whole, canvas, file }}; }}; }}"""  # noqa: E501
        )
        _wait(page, f"{SIGHT}.seen?.lens.width === 400")


CAMERAS = (
    Camera("PINHOLE", 640, 480, (500.0, 510.0, 320.0, 235.0)),
    Camera("SIMPLE_RADIAL", 640, 480, (500.0, 320.0, 235.0, -0.2)),
    Camera("OPENCV", 640, 480, (500.0, 510.0, 320.0, 235.0, -0.2, 0.05, 0.001, -0.002)),
    Camera(
        "FULL_OPENCV",
        640,
        480,
        (500.0, 510.0, 320.0, 235.0, 0.1, 0.05, 0.001, -0.002, 0.01, 0.2, 0.02, 0.01),
    ),
    Camera("OPENCV_FISHEYE", 640, 480, (300.0, 310.0, 320.0, 235.0, 0.02, -0.01, 0.003, -0.001)),
    Camera("FISHEYE", 640, 480, (300.0, 310.0, 320.0, 235.0)),
)


@pytest.mark.parametrize("camera", CAMERAS, ids=[one.model for one in CAMERAS])
def test_points_are_projected_as_the_camera_does(phone: Phone, camera: Camera):
    rng = np.random.default_rng(0)
    pose = Rigid3.from_json({"translation": [1.0, -2.0, 0.5], "quat_wxyz": [0.5, 0.5, -0.5, 0.5]})
    points_img = rng.uniform([20, 20], [620, 460], (50, 2))
    rays = camera.rays_from_img(points_img)
    depths = rng.uniform(0.5, 8.0, (50, 1))
    points = pose.apply(rays / rays[:, 2:] * depths)
    page = phone.browser.new_page()
    page.goto(phone.service.url)
    there, back = page.evaluate(
        """async ([pose, camera, points]) => {
          const { lensOf, projected, unprojected, viewOf } =
            await import("topoloc/page/projection");
          const [view, lens] = [viewOf(pose), lensOf(camera)];
          const there = points.map((point) => projected(view, lens, point));
          return [there, there.map(([u, v, depth]) => unprojected(view, lens, [u, v], depth))];
        }""",
        [pose.to_json(), camera.to_json(), points.tolist()],
    )
    np.testing.assert_allclose(there, np.hstack([points_img, depths]), atol=0.01)
    np.testing.assert_allclose(back, points, atol=0.01)
    page.close()


def test_a_note_lies_on_the_surface_in_front(phone: Phone):
    """The note lies on the nearer of two walls, not on a stray point in front of them."""
    side = np.arange(-2.0, 2.01, 0.05)
    x, y = (axis.ravel() for axis in np.meshgrid(side, side))
    walls = [np.stack([x, y, np.full(x.size, z)], axis=1) for z in (3.0, 6.0)]
    points = np.concatenate([*walls, [[0.0, 0.0, 1.0]]])
    page = phone.browser.new_page()
    page.goto(phone.service.url)
    places = page.evaluate(
        """async (points) => {
          const { lensOf, placeAt, viewOf } = await import("topoloc/page/projection");
          const view = viewOf({ translation: [0, 0, 0], quat_wxyz: [1, 0, 0, 0] });
          const lens = lensOf({ width: 640, height: 480, f: 500, cx: 320, cy: 240 });
          const at = (pixel) => placeAt(view, lens, Float32Array.from(points), pixel);
          return [at([320, 240]), at([420, 240]), at([-300, 240])];
        }""",
        points.ravel().tolist(),
    )
    np.testing.assert_allclose(places[0], [0, 0, 3], atol=1e-6)
    np.testing.assert_allclose(places[1], [0.6, 0, 3], atol=1e-6)
    assert places[2] is None
    page.close()


def test_without_webgl_a_plan_shows_the_pose(phone: Phone):
    script = """const first = HTMLCanvasElement.prototype.getContext;
      HTMLCanvasElement.prototype.getContext = function (kind, ...rest) {
        return kind === "2d" ? first.call(this, kind, ...rest) : null; };"""
    with live(phone, script, (1300, 800)) as page:
        page.get_by_text("This is the plan from above.").wait_for(state="attached")
        _wait(page, "document.getElementById('scene').viewer.plan?.answer?.localized")
        canvas = page.locator("#scene canvas").screenshot()
        image = read_image(EncodedImage("plan", canvas))[:, :, :3]
        places = np.argwhere((image == [255, 61, 129]).all(axis=2))
        assert len(places) > 50
        assert (np.abs(places.mean(axis=0) / image.shape[:2] - 0.5) < 0.48).all()


def test_the_token_of_the_link_leaves_the_address(room_map: Path, tmp_path: Path, phone: Phone):
    (tmp_path / "token").write_text("a-token-of-some-length")
    with running(room_map, "--token-file", tmp_path / "token") as service:
        page = phone.browser.new_page()
        page.goto(f"{service.url}/#token=a-token-of-some-length")
        page.wait_for_selector("#scene canvas")
        assert page.url == f"{service.url}/"
        assert page.evaluate("history.length") <= 2
        page.close()
        page = phone.browser.new_page()
        page.goto(f"{service.url}/#token=another-token-of-this-length")
        page.get_by_text("The bearer token").wait_for()
        page.get_by_text("This service needs a token: scan the code").wait_for()
        page.close()
