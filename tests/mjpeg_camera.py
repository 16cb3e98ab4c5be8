"""Serve JPEG images one after the other over HTTP on this machine, like many network cameras."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer

import cv2
import numpy as np


@contextmanager
def mjpeg_camera(
    pictures: Sequence[np.ndarray], period_s: float, hangs: bool = False
) -> Iterator[str]:
    """Yield the URL. Each image (grey or BGR) is sent once. Then the stream ends, or `hangs`."""
    ended = threading.Event()
    data = [
        cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, 97])[1].tobytes()
        for picture in pictures
    ]

    class Handler(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            self.send_response(200)
            self.send_header("Content-Type", "multipart/x-mixed-replace; boundary=picture")
            self.end_headers()
            try:
                for jpeg in data:
                    self.wfile.write(
                        b"--picture\r\nContent-Type: image/jpeg\r\nContent-Length: %d\r\n\r\n%s\r\n"
                        % (len(jpeg), jpeg)
                    )
                    time.sleep(period_s)
            except OSError:  # the client has gone
                return
            if hangs:
                ended.wait(20.0)

        def log_message(self, format: str, *args: object) -> None:
            pass

    server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
    threading.Thread(target=server.serve_forever, daemon=True).start()
    try:
        yield f"http://127.0.0.1:{server.server_port}/camera.mjpg"
    finally:
        ended.set()
        server.shutdown()
        server.server_close()
