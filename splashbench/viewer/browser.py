"""A headless Chromium, driven by its DevTools protocol: for `--screenshot`, the tests and the benchmark.

It draws without a graphics card (SwiftShader), so it needs nothing but the program.
"""

from __future__ import annotations

import base64
import json
import shutil
import subprocess
import tempfile
import time
from pathlib import Path
from typing import Any
from urllib.request import urlopen

from splashbench.errors import SplashbenchError
from splashbench.processes import ends_within, has_ended

#: Names that the program has.
PROGRAMS = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable")
_OPTIONS = (
    *("--headless=new", "--no-sandbox", "--no-first-run", "--hide-scrollbars", "--remote-debugging-port=0"),
    *("--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"),
    # Its own calls home; and no throttling where it believes that nobody looks.
    *("--disable-background-networking", "--disable-component-update", "--disable-renderer-backgrounding"),
)
_START_SECONDS = 60.0
# Else viser draws up to a quarter fewer pixels a side where drawing is slow.
_FULL_SIZE = "?fixedDpr=1"


def find_browser() -> str:
    """The program's path. Raises SplashbenchError where there is none."""
    for name in PROGRAMS:
        if found := shutil.which(name):
            return found
    raise SplashbenchError(
        f"a screenshot needs a browser, one of {', '.join(PROGRAMS)} (Debian: apt install chromium); install one, or "
        "press the viewer's own button"
    )


class Browser:
    """A page of a headless browser. Use it in a `with` statement.

    Args:
        address: of the page. size: of the window, width and height in pixels.

    Attributes:
        complaints: errors that the page's scripts raised or wrote to its console so far.
        requests: addresses that it asked for so far.
    """

    def __init__(self, address: str, size: tuple[int, int] = (1200, 800)) -> None:
        self._address, self._size = address, size
        self.complaints: list[str] = []
        self.requests: list[str] = []
        self._number = 0
        self._process: subprocess.Popen[bytes] | None = None
        self._socket: Any = None
        self._profile: tempfile.TemporaryDirectory[str] | None = None

    def __enter__(self) -> Browser:
        from websockets.sync.client import connect

        self._profile = tempfile.TemporaryDirectory(prefix="splashbench-browser-", ignore_cleanup_errors=True)
        words = [f"--user-data-dir={self._profile.name}", f"--window-size={self._size[0]},{self._size[1]}"]
        try:
            self._process = subprocess.Popen(
                [find_browser(), *_OPTIONS, *words, "about:blank"],
                stdout=subprocess.DEVNULL,
                stderr=subprocess.DEVNULL,
                start_new_session=True,
            )
            port = self._port()
            with urlopen(f"http://127.0.0.1:{port}/json", timeout=_START_SECONDS) as answer:
                (page,) = (target for target in json.load(answer) if target["type"] == "page")
            # A page that draws slowly answers no pings.
            self._socket = connect(page["webSocketDebuggerUrl"], max_size=None, ping_interval=None)
            for domain in ("Page", "Runtime", "Log", "Network"):
                self.call(f"{domain}.enable")
            width, height = self._size
            # The window is less high than was asked for, by the bars that it would have.
            self.call(
                "Emulation.setDeviceMetricsOverride", width=width, height=height, deviceScaleFactor=1, mobile=False
            )
            self.call("Page.navigate", url=self._address + _FULL_SIZE)
        except BaseException:
            self.__exit__()
            raise
        return self

    def _port(self) -> int:
        """The port of its DevTools, which it writes into its profile."""
        assert self._profile is not None
        assert self._process is not None
        written = Path(self._profile.name, "DevToolsActivePort")
        end = time.monotonic() + _START_SECONDS
        while time.monotonic() < end and not has_ended(self._process):
            lines = written.read_text().splitlines() if written.is_file() else []
            if len(lines) > 1:
                return int(lines[0])
            time.sleep(0.05)
        raise SplashbenchError("the browser did not start within a minute; try `chromium --headless` by itself")

    def __exit__(self, *_: object) -> None:
        """End it, with the processes it started."""
        import os
        import signal

        if self._socket is not None:
            self._socket.close()
        if self._process is not None:
            self._process.terminate()
            if not ends_within(self._process, 10):
                os.killpg(self._process.pid, signal.SIGKILL)
            self._process.wait()
        if self._profile is not None:
            self._profile.cleanup()

    def call(self, method: str, timeout: float = 120.0, **parameters: Any) -> Any:
        """What the DevTools' `method` returns. Raises SplashbenchError where it fails or does not answer."""
        self._number += 1
        number = self._number
        self._socket.send(json.dumps({"id": number, "method": method, "params": parameters}))
        end = time.monotonic() + timeout
        while True:
            try:
                message = json.loads(self._socket.recv(max(0.0, end - time.monotonic())))
            except TimeoutError:
                raise SplashbenchError(f"the browser did not answer within {timeout:g} s ({method})") from None
            if message.get("id") == number:
                if "error" in message:
                    raise SplashbenchError(f"the browser refused {method}: {message['error'].get('message')}")
                return message["result"]
            self._note(message)

    def _note(self, event: dict[str, Any]) -> None:
        kind, found = event.get("method"), event.get("params", {})
        if kind == "Runtime.exceptionThrown":
            details = found["exceptionDetails"]
            self.complaints.append(details.get("exception", {}).get("description", details.get("text", "")))
        elif kind == "Runtime.consoleAPICalled" and found["type"] in ("error", "assert"):
            self.complaints.append(" ".join(str(word.get("value", word.get("description"))) for word in found["args"]))
        elif kind == "Log.entryAdded" and found["entry"]["level"] == "error":
            self.complaints.append(f"{found['entry']['text']} {found['entry'].get('url', '')}".strip())
        elif kind == "Network.requestWillBeSent":
            self.requests.append(found["request"]["url"])
        elif kind == "Network.webSocketCreated":
            self.requests.append(found["url"])

    def evaluate(self, script: str) -> Any:
        """The value of the JavaScript expression `script`, a promise's result where it is one."""
        found = self.call("Runtime.evaluate", expression=script, awaitPromise=True, returnByValue=True)
        if "exceptionDetails" in found:
            raise SplashbenchError(f"the page raised {found['exceptionDetails'].get('text')} in {script[:60]!r}")
        return found["result"].get("value")

    def screenshot(self) -> bytes:
        """The window as PNG, controls included."""
        return base64.b64decode(self.call("Page.captureScreenshot", format="png")["data"])
