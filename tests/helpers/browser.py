"""Node and Chromium for tests of files that browsers read; such tests skip where these are not set up."""

import functools
import http.server
import importlib.util
import json
import os
import queue
import shutil
import subprocess
import threading
import urllib.parse
from pathlib import Path
from typing import Any

import pytest

WEB = Path(__file__).resolve().parents[1] / "web"
BROWSERS = ("chromium", "chromium-browser", "google-chrome")


def require_web(*programs: str) -> None:
    """Skips the test with a reason, or fails it where TWOFOLD_REQUIRE_WEB=1, unless everything is there."""
    missing = [name for name in programs if not any(shutil.which(one) for one in name.split("|"))]
    if not (WEB / "node_modules" / "three").is_dir():
        missing.append("the packages of `make web-tools`")
    if missing:
        reason = f"not here: {', '.join(missing)}"
        if os.environ.get("TWOFOLD_REQUIRE_WEB") == "1":
            pytest.fail(reason)
        pytest.skip(reason)


def require_browser() -> None:
    """Skips the test, or fails it where TWOFOLD_REQUIRE_WEB=1, unless Chromium and the package viser are there."""
    missing = [] if any(shutil.which(one) for one in BROWSERS) else ["|".join(BROWSERS)]
    missing += [] if importlib.util.find_spec("viser") else ["the package viser"]
    if missing:
        reason = f"not here: {', '.join(missing)}"
        if os.environ.get("TWOFOLD_REQUIRE_WEB") == "1":
            pytest.fail(reason)
        pytest.skip(reason)


def validate_gltf(*files: Path) -> list[dict[str, Any]]:
    """The official validator's issues of each file."""
    require_web("node")
    words = ["node", str(WEB / "validate.cjs"), *map(str, files)]
    done = subprocess.run(words, capture_output=True, text=True, check=True, timeout=120)
    return [json.loads(line)["issues"] for line in done.stdout.splitlines()]


def load_in_browser(file: Path, times: list[float], every: int, profile: Path) -> dict[str, Any]:
    """What `check.html` finds when Chromium loads a file with three.js; the image of each time as a data URL.

    Args:
        file: GLB or VRM.
        times: of its first animation, seconds.
        every: every Nth vertex is reported.
        profile: an empty folder for the browser.
    """
    require_web("|".join(BROWSERS))
    results: queue.Queue[dict[str, Any]] = queue.Queue()

    class Handler(http.server.SimpleHTTPRequestHandler):
        def do_GET(self) -> None:
            if self.path != "/exported":
                super().do_GET()
                return
            self.send_response(200)
            self.end_headers()
            self.wfile.write(file.read_bytes())

        def do_POST(self) -> None:
            results.put(json.loads(self.rfile.read(int(self.headers["Content-Length"]))))
            self.send_response(204)
            self.end_headers()

        def log_message(self, format: str, *arguments: object) -> None:
            del format, arguments

    server = http.server.ThreadingHTTPServer(("127.0.0.1", 0), functools.partial(Handler, directory=str(WEB)))
    threading.Thread(target=server.serve_forever, daemon=True).start()
    wanted = urllib.parse.quote(json.dumps({"file": "/exported", "times": times, "every": every}))
    browser = next(path for name in BROWSERS if (path := shutil.which(name)))
    words = [
        browser, "--headless=new", "--no-sandbox", "--disable-dev-shm-usage", "--use-angle=swiftshader",
        "--enable-unsafe-swiftshader", "--no-first-run", "--disable-extensions", f"--user-data-dir={profile}",
        "--disable-background-networking", f"http://127.0.0.1:{server.server_port}/check.html#{wanted}",
    ]  # fmt: skip
    running = subprocess.Popen(words, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    try:
        found = results.get(timeout=180)
    except queue.Empty:
        pytest.fail("the page gave no answer within three minutes")
    finally:
        running.terminate()
        running.wait(30)
        server.shutdown()
        server.server_close()
    assert "error" not in found, found["error"]
    return found
