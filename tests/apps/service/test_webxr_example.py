"""Test the WebXR example in a real browser, as a page of another origin. Augmented reality needs a
phone, so the test makes the session itself."""

from __future__ import annotations

import base64
import json
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import pytest
from running_service import running

from in_browser import chromium
from topoloc.geometry.geodesy import CAM_FROM_BODY, GeoPoint, GeoPose
from topoloc.geometry.rigid import Rigid3

GL_FROM_CV = np.diag([1.0, -1.0, -1.0])

# A session whose camera sees one image. `window.drawn`: the pixels of the axes, from the bottom;
# `window.wasEmpty`: a frame showed none, however soon the answer came.
SESSION = """(([image, projection, pose, inverse]) => {
  const picture = new Image();
  picture.src = image;
  let gl;
  window.XRWebGLLayer = class {
    framebuffer = null;
    getViewport() { return { x: 0, y: 0, width: 300, height: 150 }; }
  };
  window.XRWebGLBinding = class {
    constructor(_, context) { gl = context; }
    getCameraImage() {
      const texture = gl.createTexture();
      gl.bindTexture(gl.TEXTURE_2D, texture);
      gl.pixelStorei(gl.UNPACK_FLIP_Y_WEBGL, true);
      gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGBA, gl.RGBA, gl.UNSIGNED_BYTE, picture);
      return texture;
    }
  };
  const transform = { matrix: new Float32Array(pose), inverse: { matrix: new Float32Array(inverse) } };
  const view = { transform, projectionMatrix: new Float32Array(projection) };
  const session = {
    renderState: {},
    updateRenderState(state) { this.renderState = state; },
    requestReferenceSpace: async () => ({}),
    addEventListener() {},
    requestAnimationFrame(draw) {
      requestAnimationFrame((time) => {
        view.camera = { width: picture.width, height: picture.height };
        draw(time, { getViewerPose: () => ({ views: [view] }) });
        const pixels = new Uint8Array(4 * 300 * 150);
        gl.readPixels(0, 0, 300, 150, gl.RGBA, gl.UNSIGNED_BYTE, pixels);
        window.drawn = [...pixels.keys()].filter((k) => k % 4 < 3 && pixels[k] > 100).map((k) => [(k >> 2) % 300, Math.floor((k >> 2) / 300)]);
        window.wasEmpty ||= window.drawn.length === 0;
      });
    },
  };
  const xr = { isSessionSupported: async () => true, requestSession: async () => session };
  Object.defineProperty(navigator, "xr", { value: xr });
})"""  # noqa: E501


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    with chromium() as browser:
        yield browser


@pytest.fixture(scope="module")
def service_url(maps: Path, site: str) -> Iterator[str]:
    with running(maps / "earth.topo", "--allow-origin", site) as service:
        yield service.url


@contextmanager
def _example(browser: Any, site: str, script: str = "") -> Iterator[Any]:
    """Open the page of the example. Any error on its console fails the test."""
    page, errors = browser.new_page(), list[str]()
    page.on("console", lambda one: errors.append(one.text) if one.type == "error" else None)
    page.on("pageerror", lambda error: errors.append(str(error)))
    if script:
        page.add_init_script(script)
    page.goto(f"{site}/examples/webxr/")
    yield page
    # a browser counts the status of a refusal, 404, among the errors
    assert [error for error in errors if "status of 404" not in error] == []
    page.close()


def test_it_loads_and_names_missing_features(browser: Any, site: str):
    with _example(browser, site) as page:
        page.wait_for_function("!support.textContent.startsWith('Looking')")
        assert "choose a picture" in page.inner_text("#support").lower()
        assert page.is_disabled("#start")


def test_a_picture_is_localized_from_another_origin(
    browser: Any, site: str, service_url: str, view: Path, tmp_path: Path
):
    with _example(browser, site) as page:
        page.fill("#url", service_url)
        page.set_input_files("#picture", view)
        page.wait_for_function("log.textContent.startsWith('Localized')")
        assert "50.8" in page.inner_text("#log")
        grey = tmp_path / "grey.pgm"
        grey.write_bytes(b"P5\n64 48\n255\n" + bytes(64 * 48))
        page.set_input_files("#picture", grey)
        page.wait_for_function("log.textContent.startsWith('Not localized: too_few_matches')")


def _in_module(browser: Any, site: str, call: str, *args: object) -> np.ndarray:
    """Return the result of a function in the example's geometry.js."""
    with _example(browser, site) as page:
        program = (
            "([call, args]) => import('/examples/webxr/geometry.js').then((g) => g[call](...args))"
        )
        return np.array(page.evaluate(program, [call, list(args)]))


def _columns(pose: Rigid3) -> list[float]:
    return (
        np.block([[pose.rotation, pose.translation[:, None]], [np.zeros(3), 1]]).T.ravel().tolist()
    )


def _pose(seed: int) -> Rigid3:
    numbers = np.random.default_rng(seed)
    return Rigid3.exp(np.concatenate([numbers.normal(size=3), numbers.normal(size=3)]))


def test_east_north_up_is_placed_in_the_session(browser: Any, site: str):
    session_from_camera, enu_from_body = _pose(1), Rigid3(_pose(2).rotation, np.zeros(3))
    w, x, y, z = enu_from_body.quat_wxyz().tolist()
    quaternion = {"x": x, "y": y, "z": z, "w": w}
    found = _in_module(browser, site, "sessionFromEnu", _columns(session_from_camera), quaternion)
    body = Rigid3(GL_FROM_CV @ CAM_FROM_BODY, np.zeros(3))
    expected = session_from_camera @ body @ enu_from_body.inverse()
    np.testing.assert_allclose(found, _columns(expected), atol=1e-9)


def test_metres_between_places(browser: Any, site: str):
    start, end = GeoPoint(50.87, 4.70, 30.0), GeoPoint(50.8709, 4.6986, 41.0)
    places = ({"lat": one.lat, "lon": one.lon, "h": one.h} for one in (start, end))
    found = _in_module(browser, site, "enuFromPlaces", *places)
    expected = start.ecef_from_enu().inverse().apply(end.ecef())
    assert abs(expected[1] - 100.0) < 1.0
    np.testing.assert_allclose(found, expected, atol=1e-6)


def _projection(fx: float, fy: float, cx: float, cy: float, width: int, height: int) -> list[float]:
    """Return an OpenGL projection matrix with this calibration, column by column."""
    rows = [
        [2 * fx / width, 0, 1 - 2 * cx / width, 0],
        [0, 2 * fy / height, 2 * cy / height - 1, 0],
        [0, 0, -1.002, -0.2],
        [0, 0, -1, 0],
    ]
    return np.array(rows).T.ravel().tolist()


def test_the_calibration_is_that_of_the_projection(browser: Any, site: str):
    projection = _projection(410.0, 420.0, 330.0, 190.0, 640, 400)
    fx, fy, cx, cy = _in_module(browser, site, "intrinsics", projection, 640, 400)
    point = np.array([0.3, -0.2, 2.0])
    clip = np.array(projection).reshape(4, 4).T @ [*(GL_FROM_CV @ point), 1.0]
    x, y = clip[:2] / clip[3]
    pixel = (x + 1) / 2 * 640, (1 - y) / 2 * 400
    np.testing.assert_allclose(pixel, (fx * 0.15 + cx, fy * -0.1 + cy))


def test_a_session_places_the_axes(
    browser: Any, site: str, service_url: str, view: Path, camera: str
):
    known, pose = json.loads(camera), _pose(3)
    values = (known["fx"], known["fy"], known["cx"] + 0.5, known["cy"] + 0.5)
    projection = _projection(*values, known["width"], known["height"])
    asked = {"files": {"image": view.read_bytes()}, "data": {"camera": camera}}
    found = httpx.post(f"{service_url}/v1/maps/earth/localize", **asked, timeout=60.0).json()
    geopose = GeoPose.from_json(found["geopose"])
    enu_from_body = Rigid3.from_quat_wxyz(geopose.quat_wxyz, np.zeros(3))
    place = geopose.position.ecef_from_enu() @ enu_from_body
    there = GeoPoint.from_ecef(place.apply(np.array([3.0, 0.0, 0.0])))
    ahead = f"{there.lat:.9f}, {there.lon:.9f}, {there.h:.4f}"
    image = f"data:image/png;base64,{base64.b64encode(view.read_bytes()).decode()}"
    given = [image, projection, _columns(pose), _columns(pose.inverse())]
    with _example(browser, site, f"{SESSION}({json.dumps(given)})") as page:
        page.wait_for_selector("#start:not([disabled])")
        page.fill("#url", service_url)
        page.fill("#anchor", ahead)
        page.click("#start")
        page.wait_for_function("window.wasEmpty")
        page.wait_for_function("log.textContent.startsWith('Localized')")
        page.wait_for_function("window.drawn.length > 0")
        pixels = np.array(page.evaluate("window.drawn"))
    origin = np.array([values[2] / known["width"] * 300, (1 - values[3] / known["height"]) * 150])
    distances = np.linalg.norm(pixels + 0.5 - origin, axis=1)
    assert distances.min() < 3.0, "the axes begin at the place, which is straight ahead"
    assert distances.max() > 10.0
