"""Chromium, driven by its developer tools over a pipe: pages from the disk, the network off, screenshots."""

import base64
import contextlib
import json
import os
import select
import shutil
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from browser import BROWSERS, require_web

_LAUNCHER = """
import fcntl, os, sys
inward, outward = (fcntl.fcntl(int(word), fcntl.F_DUPFD, 20) for word in sys.argv[1:3])
os.dup2(inward, 3)
os.dup2(outward, 4)
os.execvp(sys.argv[3], sys.argv[3:])
"""
"""The browser reads commands from descriptor 3 and answers on 4."""
NOT_FROM_ELSEWHERE = ("file:", "data:", "blob:", "about:")


class Tab:
    """One tab: what it requested, what it logged, and commands to it."""

    def __init__(self, process: subprocess.Popen[bytes], to: int, back: int) -> None:
        self.process, self.to, self.back = process, to, back
        self.buffer, self.number, self.session = b"", 0, ""
        self.requests: list[str] = []
        self.problems: list[str] = []

    def send(self, method: str, **parameters: Any) -> dict[str, Any]:
        """Sends a command and waits for its answer."""
        self.number += 1
        message = {"id": self.number, "method": method, "params": parameters}
        if self.session:
            message["sessionId"] = self.session
        os.write(self.to, json.dumps(message).encode() + b"\0")
        wanted = self.number
        for found in self._messages(120):
            if found.get("id") == wanted:
                assert "error" not in found, found["error"]
                return found["result"]
        raise AssertionError(f"no answer to {method}")

    def listen(self, seconds: float) -> None:
        """Takes in events for a while."""
        for _ in self._messages(seconds):
            pass

    def _messages(self, seconds: float) -> Iterator[dict[str, Any]]:
        end = time.monotonic() + seconds
        while True:
            while b"\0" in self.buffer:
                one, _, self.buffer = self.buffer.partition(b"\0")
                message = json.loads(one)
                self._note(message)
                yield message
            left = end - time.monotonic()
            if left <= 0 or not select.select([self.back], [], [], left)[0]:
                return
            self.buffer += os.read(self.back, 1 << 20)

    def _note(self, message: dict[str, Any]) -> None:
        parameters = message.get("params", {})
        if message.get("method") == "Network.requestWillBeSent":
            self.requests.append(parameters["request"]["url"])
        if message.get("method") == "Runtime.exceptionThrown":
            self.problems.append(json.dumps(parameters["exceptionDetails"])[:500])
        if message.get("method") == "Log.entryAdded" and parameters["entry"]["level"] == "error":
            self.problems.append(parameters["entry"]["text"])

    def open(self, page: Path, width: int, height: int, dark: bool = False, phone: bool = False) -> None:
        """Loads a page from the disk with the network off."""
        self.send("Emulation.setDeviceMetricsOverride", width=width, height=height, deviceScaleFactor=1, mobile=phone)
        self.send("Emulation.setTouchEmulationEnabled", enabled=phone)
        scheme = {"name": "prefers-color-scheme", "value": "dark" if dark else "light"}
        self.send("Emulation.setEmulatedMedia", features=[scheme])
        self.send("Page.navigate", url=page.resolve().as_uri())

    def run(self, script: str) -> Any:
        """The value of a JavaScript expression; promises are waited for."""
        answer = self.send("Runtime.evaluate", expression=script, returnByValue=True, awaitPromise=True)
        assert "exceptionDetails" not in answer, answer["exceptionDetails"]
        return answer["result"].get("value")

    def wait_for(self, script: str, seconds: float = 60) -> None:
        """Waits until an expression is true."""
        end = time.monotonic() + seconds
        while not self.run(script):
            assert time.monotonic() < end, f"{script} did not become true; {self.problems}"
            self.listen(0.2)

    def screenshot(self, whole: bool = False) -> bytes:
        """What is to be seen, or the whole page, as PNG."""
        shot = self.send("Page.captureScreenshot", format="png", captureBeyondViewport=whole)
        return base64.b64decode(shot["data"])

    def touch(self, kind: str, *points: tuple[float, float]) -> None:
        """A touch event: touchStart, touchMove or touchEnd."""
        self.send("Input.dispatchTouchEvent", type=kind, touchPoints=[{"x": x, "y": y} for x, y in points])


@contextlib.contextmanager
def browser_tab(profile: Path) -> Iterator[Tab]:
    """A tab of a new Chromium that reaches no host; skips or fails as `require_web` does."""
    require_web("|".join(BROWSERS))
    browser = next(path for name in BROWSERS if (path := shutil.which(name)))
    words = [
        browser, "--headless=new", "--no-sandbox", "--disable-dev-shm-usage", "--use-angle=swiftshader",
        "--enable-unsafe-swiftshader", "--no-first-run", "--disable-extensions", f"--user-data-dir={profile}",
        "--disable-background-networking", "--host-resolver-rules=MAP * ~NOTFOUND", "--remote-debugging-pipe",
    ]  # fmt: skip
    inward, to = os.pipe()
    back, outward = os.pipe()
    launcher = [sys.executable, "-c", _LAUNCHER, str(inward), str(outward), *words]
    process = subprocess.Popen(
        launcher, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, pass_fds=(inward, outward)
    )
    os.close(inward)
    os.close(outward)
    tab = Tab(process, to, back)
    try:
        target = tab.send("Target.createTarget", url="about:blank")["targetId"]
        tab.session = tab.send("Target.attachToTarget", targetId=target, flatten=True)["sessionId"]
        for domain in ("Page", "Runtime", "Network", "Log"):
            tab.send(f"{domain}.enable")
        tab.send("Network.emulateNetworkConditions", offline=True, latency=0, downloadThroughput=0, uploadThroughput=0)
        yield tab
    finally:
        process.terminate()
        process.wait(30)
        os.close(to)
        os.close(back)
