"""A page as a picture, by a Chromium or Chrome of this machine without a window."""

from __future__ import annotations

import os
import shutil
import subprocess
import tempfile
from pathlib import Path

from topoloc import TopolocError
from topoloc.plugin import write_bytes

BROWSERS = (
    "chromium",
    "chromium-browser",
    "google-chrome",
    "google-chrome-stable",
    "chrome",
    "microsoft-edge",
)
_SOFTWARE_3D = (
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
)  # WebGL where there is no graphics card
_TIMEOUT_S, _VIRTUAL_MS = 120.0, 3_000


def find_browser() -> str:
    """The program. Raises TopolocError where there is none."""
    found = next((path for name in BROWSERS if (path := shutil.which(name))), None)
    if found is None:
        raise TopolocError(
            f"a picture of a page needs one of {', '.join(BROWSERS[:3])}, and none is installed"
        )
    return found


def write_screenshot(page: Path, out: Path, width: int = 1300, height: int = 850) -> None:
    """What the page shows in a window of this size (pixels), as PNG.

    Raises:
        TopolocError: there is no browser, it fails, or the file cannot be written.
    """
    browser = find_browser()
    with tempfile.TemporaryDirectory(prefix="topoloc-view-") as profile:
        picture = Path(profile) / "page.png"
        arguments = (
            "--headless=new",
            "--no-first-run",
            "--hide-scrollbars",
            *_SOFTWARE_3D,
            f"--user-data-dir={profile}",
        )
        arguments += (
            ("--no-sandbox",) if hasattr(os, "geteuid") and os.geteuid() == 0 else ()
        )  # Chromium's refuses to be root's
        arguments += (
            f"--virtual-time-budget={_VIRTUAL_MS}",
            f"--window-size={width},{height}",
            f"--screenshot={picture}",
        )
        try:
            done = subprocess.run(
                [browser, *arguments, page.resolve().as_uri()],
                capture_output=True,
                timeout=_TIMEOUT_S,
                check=False,
            )
        except subprocess.TimeoutExpired:
            raise TopolocError(f"{browser} made no picture within {_TIMEOUT_S:g} s") from None
        if done.returncode or not picture.is_file():
            said = done.stderr.decode(errors="replace").strip().splitlines()
            raise TopolocError(
                f"{browser} made no picture:"
                f" {said[-1][:200] if said else f'exit status {done.returncode}'}"
            )
        write_bytes(out, picture.read_bytes())
