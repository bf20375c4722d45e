"""Headless Debian Chromium, controlled over a pipe without a port or a library.

Source: Chrome DevTools Protocol, `--remote-debugging-pipe`: JSON messages that end with a zero
byte, to file descriptor 3 and from 4.
"""

import base64
import json
import os
import shutil
import subprocess
from pathlib import Path

import pytest

FLAGS = (
    *("--headless", "--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run"),
    *("--disable-background-networking", "--disable-component-update", "--disable-sync"),
    *("--disable-default-apps", "--disable-extensions", "--hide-scrollbars", "--mute-audio"),
    "--host-resolver-rules=MAP * ~NOTFOUND, EXCLUDE 127.0.0.1",  # prevents even name lookups
    "--remote-debugging-pipe",
)


def chromium():
    """Return the path of Chromium, or None if it is not installed."""
    return shutil.which("chromium")


def started(tmp_path_factory):
    """Start a browser for a fixture, and end it afterwards; skip the tests without Chromium."""
    if chromium() is None:
        pytest.skip("chromium is not installed: apt-get install chromium")
    with Browser(tmp_path_factory.mktemp("profile")) as one:
        yield one


class Browser:
    """One page in one browser; a context manager that ends it.

    Attributes:
        requests: addresses requested by the page, in order.
        errors: exceptions and console errors, in order.
    """

    def __init__(self, profile: Path, width=1400, height=900):
        to_browser, self._out = os.pipe()
        self._in, from_browser = os.pipe()
        words = [chromium(), *FLAGS, f"--user-data-dir={profile}", "about:blank"]
        # The shell moves the pipes to descriptors 3 and 4, which the browser uses.
        script = 'exec 3<&"$1" 4>&"$2"; shift 2; exec "$@"'
        self._process = subprocess.Popen(
            ["bash", "-c", script, "bash", str(to_browser), str(from_browser), *words],
            pass_fds=(to_browser, from_browser),
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            stdin=subprocess.DEVNULL,
        )
        os.close(to_browser)
        os.close(from_browser)
        self._buffer = b""
        self._number = 0
        self._session = None
        self.requests, self.errors = [], []
        targets = self.call("Target.getTargets")["targetInfos"]
        page = next(one["targetId"] for one in targets if one["type"] == "page")
        found = self.call("Target.attachToTarget", targetId=page, flatten=True)
        self._session = found["sessionId"]
        for domain in ("Page", "Runtime", "Network", "Log"):
            self.call(f"{domain}.enable")
        self.size(width, height)

    def __enter__(self):
        return self

    def __exit__(self, *_):
        try:
            self._session = None
            self.call("Browser.close")
        except (OSError, EOFError):
            pass
        try:
            self._process.wait(timeout=20)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        os.close(self._out)
        os.close(self._in)

    def call(self, method, **parameters):
        """Return the browser's answer; note the events before it."""
        self._number += 1
        message = {"id": self._number, "method": method, "params": parameters}
        if self._session is not None:
            message["sessionId"] = self._session
        os.write(self._out, json.dumps(message).encode() + b"\0")
        while True:
            told = self._message()
            if told.get("id") == self._number:
                if "error" in told:
                    raise RuntimeError(f"{method}: {told['error']['message']}")
                return told["result"]
            self._note(told)

    def open(self, page: Path, fragment=""):
        """Open the page and wait until it is drawn or has failed (`errors`, its `data-error`)."""
        self.call("Page.navigate", url=page.as_uri() + fragment)
        return self.wait(
            "document.documentElement.dataset.state || document.documentElement.dataset.error"
        )

    def begin_anew(self):
        """Forget requests and errors; take the usual size and media features again."""
        self.requests.clear()
        self.errors.clear()
        self.size(1400, 900)
        self.media()

    def wait(self, condition, timeout_ms=120_000):
        """Return the condition's value once it is true; the browser itself waits."""
        return self.run(
            "new Promise((resolve, reject) => {"
            f"  const end = performance.now() + {timeout_ms};"
            "  const look = () => {"
            "    let value = null; try { value = (" + condition + "); } catch (e) { value = null; }"
            "    if (value) resolve(value);"
            "    else if (performance.now() > end) reject(new Error('waited in vain'));"
            "    else setTimeout(look, 10);"
            "  }; look(); })"
        )

    def run(self, expression):
        """Return the value of a JavaScript expression, or of its promise."""
        while True:
            try:
                told = self.call(
                    "Runtime.evaluate", expression=expression, returnByValue=True, awaitPromise=True
                )
            except RuntimeError as error:  # the page was replaced meanwhile
                if "context" in str(error).lower() or "navigated" in str(error).lower():
                    continue
                raise
            if "exceptionDetails" in told:
                details = told["exceptionDetails"]
                text = details.get("exception", {}).get("description", details["text"])
                raise RuntimeError(text)
            return told["result"].get("value")

    def drawn(self):
        """Return the number of drawn items and the range of each panel."""
        found = self.run(
            "[...document.querySelectorAll('canvas[data-panel]')].map(c =>"
            " [c.dataset.panel, ...['drawn', 'from', 'to'].map(n => Number(c.dataset[n]))])"
        )
        return {name: tuple(rest) for name, *rest in found}

    def key(self, key, **more):
        """Press and release a key."""
        for kind in ("keyDown", "keyUp"):
            self.call("Input.dispatchKeyEvent", type=kind, key=key, **more)
        self.settle()

    def mouse(self, kind, x, y, **more):
        """Send a mouse event, in pixels of the window."""
        self.call("Input.dispatchMouseEvent", type=kind, x=x, y=y, **more)

    def settle(self):
        """Wait until two frames have been drawn."""
        self.run("new Promise(r => requestAnimationFrame(() => requestAnimationFrame(() => r(1))))")

    def size(self, width, height, scale=1):
        """Set the size of the window [CSS pixels]."""
        self.call(
            "Emulation.setDeviceMetricsOverride",
            width=width,
            height=height,
            deviceScaleFactor=scale,
            mobile=False,
        )

    def media(self, **features):
        """Set media features, such as `prefers_color_scheme="dark"`."""
        told = [
            {"name": name.replace("_", "-"), "value": value} for name, value in features.items()
        ]
        self.call("Emulation.setEmulatedMedia", features=told)

    def picture(self, whole=False):
        """Return a PNG of the window, or of the whole page."""
        told = self.call("Page.captureScreenshot", format="png", captureBeyondViewport=whole)
        return base64.b64decode(told["data"])

    def _message(self):
        while b"\0" not in self._buffer:
            more = os.read(self._in, 1 << 20)
            if not more:
                raise EOFError("the browser has ended")
            self._buffer += more
        text, _, self._buffer = self._buffer.partition(b"\0")
        return json.loads(text)

    def _note(self, told):
        method, about = told.get("method"), told.get("params", {})
        if method == "Network.requestWillBeSent":
            self.requests.append(about["request"]["url"])
        elif method == "Runtime.exceptionThrown":
            details = about["exceptionDetails"]
            self.errors.append(details.get("exception", {}).get("description", details["text"]))
        elif method == "Log.entryAdded" and about["entry"]["level"] == "error":
            self.errors.append(about["entry"]["text"])
        elif method == "Runtime.consoleAPICalled" and about["type"] in ("error", "assert"):
            self.errors.append(str(about["args"]))
