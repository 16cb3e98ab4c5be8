"""Check that any bad request gets one sentence, and that other clients still get results."""

from __future__ import annotations

import base64
import io
import json
import select
import socket
import struct
import threading
import time
import zlib
from pathlib import Path
from urllib.parse import urlsplit

import httpx
import numpy as np
import pytest
from PIL import Image
from running_service import Running

LOCALIZE = "/v1/maps/room/localize"


def _png_of(width: int, height: int) -> bytes:
    """Return a small PNG file of zeros that declares this size. A large size makes it a
    decompression bomb."""

    def chunk(kind: bytes, data: bytes) -> bytes:
        return (
            struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))
        )

    header = struct.pack(">IIBBBBB", width, height, 8, 0, 0, 0, 0)
    return (
        b"\x89PNG\r\n\x1a\n"
        + chunk(b"IHDR", header)
        + chunk(b"IDAT", zlib.compress(bytes(10_000_000), 9))
        + chunk(b"IEND", b"")
    )


def _jpeg_of(width: int, height: int) -> bytes:
    file = io.BytesIO()
    Image.new("L", (width, height)).save(file, "JPEG", quality=1)
    return file.getvalue()


def _pictures(view: Path) -> dict[str, tuple[bytes, int]]:
    whole = view.read_bytes()
    return {
        "empty": (b"", 400),
        "truncated": (whole[: len(whole) // 2], 400),
        "too many pixels": (_jpeg_of(2600, 2600), 413),
        "100 megapixels": (_png_of(10_000, 10_001), 400),
        "bomb": (_png_of(60_000, 60_000), 400),
        "svg": (b'<svg xmlns="http://www.w3.org/2000/svg"><rect width="9" height="9"/></svg>', 400),
        "pdf": (b"%PDF-1.7\n1 0 obj\n<<>>\nendobj\n", 400),
        "noise": (np.random.default_rng(0).bytes(20_000), 400),
        "too many bytes": (bytes(3_200_000), 413),
    }


FEATURE_TYPES = [
    "empty",
    "truncated",
    "too many pixels",
    "100 megapixels",
    "bomb",
    "svg",
    "pdf",
    "noise",
    "too many bytes",
]


def _check(answer: httpx.Response, status: int) -> str:
    assert answer.status_code == status, answer.text
    error = answer.json()["error"]
    assert "\n" not in error
    assert 5 < len(error) < 300
    assert answer.json()["request_id"] == answer.headers["x-request-id"]
    return error


@pytest.mark.parametrize("kind", FEATURE_TYPES)
def test_invalid_images_are_refused(client: httpx.Client, view: Path, kind: str):
    data, status = _pictures(view)[kind]
    _check(client.post(LOCALIZE, files={"image": ("picture.jpg", data)}), status)
    _check(client.post(LOCALIZE, content=data, headers={"content-type": "image/jpeg"}), status)


@pytest.mark.parametrize("kind", ["PNG", "JPEG", "WEBP", "BMP", "TIFF"])
def test_base64_is_named_with_a_remedy(client: httpx.Client, view: Path, kind: str):
    """As the body, in JSON, as a file or as a text of a form, alone and as an address of data."""
    file = io.BytesIO()
    Image.open(view).convert("L").resize((64, 48)).save(file, kind)
    encoded = base64.b64encode(file.getvalue()).decode()
    for text in (encoded, f"data:image/{kind.lower()};base64,{encoded}", json.dumps(encoded)):
        image = {"content-type": f"image/{kind.lower()}"}
        long = text * (1 + 20_000 // len(text))
        for answer, status in (
            (client.post(LOCALIZE, content=text, headers=image), 415),
            (client.post(LOCALIZE, files={"image": ("picture", text.encode())}), 415),
            (client.post(LOCALIZE, files={"image": (None, text)}), 400),
            (client.post(LOCALIZE, files={"image": (None, long)}), 400),
        ):
            said = _check(answer, status)
            assert "not base64: as the body (Content-Type: image/...)" in said
    said = _check(client.post(LOCALIZE, json={"image": encoded, "camera": "1,1,1,1"}), 415)
    assert "JSON, not an image; send the bytes of the image file" in said


def test_an_image_of_letters_is_no_base64(client: httpx.Client):
    """A PNM may hold nothing but text."""
    body = b"P2\n64 48\n255\n" + b"9 " * (64 * 48)
    assert client.post(LOCALIZE, content=body).status_code == 200


def test_a_slow_client_that_sends_too_much_gets_the_reason(service: Running):
    """If the server closes a connection while the client sends, TCP resets it, and
    unread data is lost."""
    address, part = urlsplit(service.url), bytes(32_000)
    with socket.create_connection((address.hostname, address.port or 80), 20.0) as sending:
        head = (
            f"POST {LOCALIZE} HTTP/1.1\r\nHost: {address.netloc}\r\nContent-Type:"
            f" image/jpeg\r\nContent-Length: {100 * len(part)}\r\n\r\n"
        )
        sending.sendall(head.encode())
        for _ in range(100):
            sending.sendall(part)
            time.sleep(0.002)
        answer = b"".join(iter(lambda: sending.recv(65_536), b""))
    assert answer.startswith(b"HTTP/1.1 413 ")
    assert b"a request has at most" in answer


@pytest.mark.parametrize(
    "camera",
    [
        "0,0,160,120",
        "nan,260,159,119",
        "inf,260,159,119",
        "1e-300,260,159,119",
        "260,260",
        "/etc/passwd",
        "camera.json",
        "{",
        '{"model": "PINHOLE", "params": [NaN, 1, 2, 3]}',
        '{"model": "PINHOLE", "params": [0, 0, 2, 3]}',
        '{"model": "FISHEYE_OF_MINE", "params": [1]}',
        '{"model": "PINHOLE", "params": ["a", 1, 2, 3]}',
        (
            '{"model": "PINHOLE", "width": 640, "height": 480, "fx": 260, "fy": 260, "cx": 319,'
            ' "cy": 239}'
        ),
        '{"model": "PINHOLE", "width": 1e400, "height": 480, "params": [260, 260, 319, 239]}',
        f'{{"fx": {"9" * 4000}}}',
        "[" * 15_000,
    ],
    ids=lambda camera: camera[:40],
)
def test_invalid_cameras_are_refused(client: httpx.Client, view: Path, camera: str):
    _check(client.post(LOCALIZE, files={"image": view.open("rb")}, data={"camera": camera}), 422)


@pytest.mark.parametrize(
    "said",
    [
        {"max_ms": "0"},
        {"max_ms": "nan"},
        {"max_ms": "soon"},
        {"prior": "here"},
        {"prior": '{"translation": [0, 0, 0], "quat_wxyz": [0, 0, 0, 0]}'},
        {"prior": '{"translation": [0, 0, NaN], "quat_wxyz": [1, 0, 0, 0]}'},
    ],
    ids=str,
)
def test_invalid_values_are_refused(client: httpx.Client, view: Path, said: dict[str, str]):
    _check(client.post(LOCALIZE, files={"image": view.open("rb")}, data=said), 422)
    _check(
        client.post(
            LOCALIZE, params=said, content=view.read_bytes(), headers={"content-type": "image/png"}
        ),
        422,
    )


def test_invalid_forms_are_refused(client: httpx.Client, view: Path):
    _check(client.post(LOCALIZE, files={"picture": view.open("rb")}), 400)
    _check(client.post(LOCALIZE, data={"image": "text"}), 415)
    _check(
        client.post(LOCALIZE, content=b"x", headers={"content-type": "multipart/form-data"}), 400
    )
    half = (
        b'--b\r\nContent-Disposition: form-data; name="image"; filename="a.png"\r\n\r\n'
        + view.read_bytes()[:500]
    )
    _check(
        client.post(
            LOCALIZE, content=half, headers={"content-type": "multipart/form-data; boundary=b"}
        ),
        400,
    )
    many = {f"field{number}": (None, "x") for number in range(50)}
    _check(client.post(LOCALIZE, files=many), 400)


def test_missing_routes_and_maps_are_refused(client: httpx.Client, view: Path):
    _check(client.post("/v1/maps/nowhere/localize", files={"image": view.open("rb")}), 404)
    _check(
        client.post("/v1/maps/..%2F..%2Fetc%2Fpasswd/localize", files={"image": view.open("rb")}),
        404,
    )
    _check(client.get("/v1/elsewhere"), 404)
    _check(client.put("/v1/maps"), 405)
    _check(client.get("/v1/maps/" + "a" * 300), 422)


def test_other_sites_and_other_names_are_not_answered(client: httpx.Client):
    _check(client.get("/v1/maps", headers={"origin": "https://elsewhere.example"}), 403)
    _check(client.get("/v1/maps", headers={"host": "elsewhere.example"}), 421)
    assert (
        client.get("/v1/maps", headers={"origin": str(client.base_url).rstrip("/")}).status_code
        == 200
    )
    assert "access-control-allow-origin" not in client.get("/v1/maps").headers


def test_a_slow_client_is_disconnected_and_blocks_no_other(
    service: Running, client: httpx.Client, view: Path, camera: str
):
    address = urlsplit(service.url)
    assert address.hostname
    head = (
        f"POST {LOCALIZE} HTTP/1.1\r\nHost: {address.netloc}\r\nContent-Type:"
        " image/png\r\nContent-Length: 100000\r\n\r\n"
    )
    slow = [
        socket.create_connection((address.hostname, address.port or 80), 20.0) for _ in range(20)
    ]
    try:
        begun = time.monotonic()
        for one in slow:
            one.sendall(head.encode() + b"abc")
        assert client.post(
            LOCALIZE, files={"image": view.open("rb")}, data={"camera": camera}
        ).json()["localized"]
        ended = select.select(slow, [], [], 0.0)[0]
        assert ended == [] or time.monotonic() - begun > 3.9, (
            "they are waited for, while others are answered"
        )
        assert all(b" 408 " in one.recv(1000) for one in slow)
    finally:
        for one in slow:
            one.close()


def test_a_client_that_goes_away_affects_no_other(service: Running, client: httpx.Client):
    address = urlsplit(service.url)
    assert address.hostname
    with socket.create_connection((address.hostname, address.port or 80), 10.0) as gone:
        gone.sendall(
            f"POST {LOCALIZE} HTTP/1.1\r\nHost: {address.netloc}\r\nContent-Length: 1000\r\n\r\nabc".encode()  # noqa: E501
        )
    assert client.get("/healthz").json()["status"] == "ok"
    assert not any('"level": "error"' in line for line in service.log)


def test_too_many_requests_at_once_get_a_time_to_retry(service: Running, view: Path, camera: str):
    """Up to 34 requests run or wait. Of 60 at once, some get a time to retry, and all
    others a pose."""
    data = view.read_bytes()
    answers = list[httpx.Response]()

    def ask() -> None:
        with service.client() as one:
            answers.append(one.post(LOCALIZE, files={"image": data}, data={"camera": camera}))

    threads = [threading.Thread(target=ask) for _ in range(60)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    statuses = {answer.status_code for answer in answers}
    assert statuses <= {200, 429}
    assert len(answers) == 60
    for answer in answers:
        if answer.status_code == 200:
            assert answer.json()["localized"]
        else:
            assert int(answer.headers["retry-after"]) >= 1


def test_the_log_is_json_and_shows_no_picture(client: httpx.Client, service: Running, view: Path):
    client.post(LOCALIZE, files={"image": view.open("rb")}, headers={"x-request-id": "mine-17"})
    until = time.monotonic() + 20.0
    while not any("mine-17" in line for line in service.log) and time.monotonic() < until:
        time.sleep(0.02)
    lines = [json.loads(line) for line in service.log[1:]]
    (mine,) = [line for line in lines if line.get("request_id") == "mine-17"]
    assert (mine["status"], mine["map"], mine["method"]) == (200, "room", "POST")
    assert all(len(json.dumps(line)) < 1000 for line in lines if line["level"] == "info")
