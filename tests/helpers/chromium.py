"""Headless Chromium driven by its DevTools protocol: opens a page, evaluates scripts, moves the mouse, takes images."""

import base64
import json
import shutil
import subprocess
import time
from pathlib import Path
from types import TracebackType
from typing import Any

from browser import BROWSERS


class Chromium:
    """A browser with one page. Use it in a `with` block.

    Args:
        profile: an empty folder.
        width: of the page, pixels.
        height: of the page, pixels.
    """

    def __init__(self, profile: Path, width: int = 800, height: int = 600) -> None:
        self.profile, self.width, self.height = profile, width, height
        self._number = 0
        self.events: list[dict[str, Any]] = []

    def __enter__(self) -> "Chromium":
        from websockets.sync.client import connect

        browser = next(path for name in BROWSERS if (path := shutil.which(name)))
        words = [
            browser, "--headless=new", "--no-sandbox", "--disable-dev-shm-usage", "--disable-gpu",
            "--enable-unsafe-swiftshader", "--no-first-run", "--disable-extensions", "--disable-background-networking",
            "--remote-debugging-port=0", f"--window-size={self.width},{self.height}",
            f"--user-data-dir={self.profile}", "about:blank",
        ]  # fmt: skip
        self._process = subprocess.Popen(words, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        file = self.profile / "DevToolsActivePort"
        deadline = time.monotonic() + 60
        while not file.exists() or len(file.read_text().split()) < 2:
            assert time.monotonic() < deadline, "Chromium did not start"
            time.sleep(0.05)
        port, path = file.read_text().split()
        self._socket = connect(f"ws://127.0.0.1:{port}{path}", max_size=None, compression=None, ping_interval=None)
        self._session: str | None = None
        pages = [t for t in self.call("Target.getTargets")["targetInfos"] if t["type"] == "page"]
        target = pages[0]["targetId"]
        self._session = self.call("Target.attachToTarget", targetId=target, flatten=True)["sessionId"]
        for domain in ("Page", "Network", "Runtime"):
            self.call(f"{domain}.enable")
        self.call(
            "Emulation.setDeviceMetricsOverride", width=self.width, height=self.height, deviceScaleFactor=1,
            mobile=False,
        )  # fmt: skip
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._socket.close()
        self._process.terminate()
        self._process.wait(30)

    def call(self, method: str, **parameters: Any) -> dict[str, Any]:
        """Sends a command and waits for its result."""
        self._number += 1
        message: dict[str, Any] = {"id": self._number, "method": method, "params": parameters}
        if self._session:
            message["sessionId"] = self._session
        self._socket.send(json.dumps(message))
        while True:
            answer = json.loads(self._socket.recv(timeout=120))
            if answer.get("id") == self._number:
                assert "error" not in answer, answer
                return answer["result"]
            self.events.append(answer)

    def evaluate(self, script: str) -> Any:
        """The value of an expression in the page; a promise is awaited."""
        answer = self.call("Runtime.evaluate", expression=script, awaitPromise=True, returnByValue=True)
        assert "exceptionDetails" not in answer, answer["exceptionDetails"]
        return answer["result"].get("value")

    def open(self, address: str, before: str = "") -> None:
        """Loads a page; `before` is a script that runs ahead of the page's own."""
        if before:
            self.call("Page.addScriptToEvaluateOnNewDocument", source=before)
        self.call("Page.navigate", url=address)

    def until(self, condition: str, seconds: float = 60) -> None:
        """Waits until an expression is true in the page."""
        deadline = time.monotonic() + seconds
        while not self.evaluate(f"Boolean({condition})"):
            assert time.monotonic() < deadline, f"not within {seconds} s: {condition}"
            time.sleep(0.1)

    def mouse(self, kind: str, x: float, y: float, buttons: int = 0) -> None:
        """A mouse event: "mousePressed", "mouseMoved" or "mouseReleased"."""
        button = "left" if buttons or kind == "mouseReleased" else "none"
        self.call("Input.dispatchMouseEvent", type=kind, x=x, y=y, button=button, buttons=buttons, clickCount=1)

    def screenshot(self, file: Path) -> None:
        """Saves what the page shows as PNG."""
        file.write_bytes(base64.b64decode(self.call("Page.captureScreenshot", format="png")["data"]))

    def addresses(self) -> list[str]:
        """The addresses that the page has requested so far, web sockets included."""
        self.evaluate("1")
        keys = {"Network.requestWillBeSent": ("request", "url"), "Network.webSocketCreated": ("url",)}
        found: list[str] = []
        for event in self.events:
            if event.get("method") in keys:
                value: Any = event["params"]
                for key in keys[event["method"]]:
                    value = value[key]
                found.append(value)
        return found
