"""Headless Chromium for tests, by its DevTools protocol over a pipe; a test that asks for it is skipped without."""
from __future__ import annotations

import base64
import fcntl
import io
import json
import os
import shutil
import subprocess
import tempfile
import time

import pytest
from PIL import Image

NAMES = ("chromium", "chromium-browser", "google-chrome", "chrome")
SWITCHES = ("--headless=new", "--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader",
            "--force-color-profile=srgb", "--hide-scrollbars", "--no-first-run", "--disable-dev-shm-usage",
            "--remote-debugging-pipe")


class Browser:
    """One page of a browser."""

    def __init__(self, program):
        self.folder = tempfile.mkdtemp()
        theirs, self.write_end = os.pipe()
        self.read_end, answers = os.pipe()

        def as_three_and_four():  # where Chromium reads and writes
            inputs, outputs = (fcntl.fcntl(end, fcntl.F_DUPFD, 10) for end in (theirs, answers))
            os.dup2(inputs, 3)
            os.dup2(outputs, 4)

        self.process = subprocess.Popen([program, *SWITCHES, f"--user-data-dir={self.folder}", "about:blank"],
                                        preexec_fn=as_three_and_four, close_fds=False, stdout=subprocess.DEVNULL,
                                        stderr=subprocess.DEVNULL)
        os.close(theirs)
        os.close(answers)
        self.number, self.buffer, self.session = 0, b"", None
        target, = [info for info in self("Target.getTargets")["targetInfos"] if info["type"] == "page"]
        self.session = self("Target.attachToTarget", targetId=target["targetId"], flatten=True)["sessionId"]

    def __call__(self, method, **parameters):
        """Sends a command and waits for its result."""
        self.number += 1
        message = {"id": self.number, "method": method, "params": parameters}
        if self.session:
            message["sessionId"] = self.session
        os.write(self.write_end, json.dumps(message).encode() + b"\0")
        while True:
            while b"\0" not in self.buffer:
                part = os.read(self.read_end, 1 << 20)
                if not part:
                    raise RuntimeError("the browser has ended")
                self.buffer += part
            text, _, self.buffer = self.buffer.partition(b"\0")
            answer = json.loads(text)
            if answer.get("id") == self.number:
                assert "error" not in answer, answer
                return answer["result"]

    def open(self, address, width, height):
        """Opens an address in a window of that size, one image pixel a screen pixel."""
        self("Emulation.setDeviceMetricsOverride", width=width, height=height, deviceScaleFactor=1, mobile=False)
        self("Page.navigate", url=address)

    def value(self, script):
        """The value of a JavaScript expression."""
        result = self("Runtime.evaluate", expression=script, returnByValue=True, awaitPromise=True)
        assert "exceptionDetails" not in result, result
        return result["result"].get("value")

    def wait_until(self, script, seconds=60):
        """Waits until a JavaScript expression holds."""
        end = time.monotonic() + seconds
        while not self.value(script):
            assert time.monotonic() < end, f"{script} never held; the page says: " + self.value(
                "document.body.innerText")
            time.sleep(0.05)

    def drag(self, start, end):
        """Drags with the left button from one point to another, in pixels."""
        for kind, (x, y), buttons in (("mousePressed", start, 1), ("mouseMoved", end, 1), ("mouseReleased", end, 0)):
            self("Input.dispatchMouseEvent", type=kind, x=x, y=y, button="left", buttons=buttons, clickCount=1)

    def picture(self):
        """What the window shows, an RGB image."""
        data = self("Page.captureScreenshot", format="png")["data"]
        return Image.open(io.BytesIO(base64.b64decode(data))).convert("RGB")

    def close(self):
        self.process.terminate()
        self.process.wait()
        os.close(self.write_end)
        os.close(self.read_end)
        shutil.rmtree(self.folder, ignore_errors=True)


@pytest.fixture(scope="session")
def browser():
    program = next(filter(None, map(shutil.which, NAMES)), None)
    if program is None:
        pytest.skip("there is no Chromium (Debian: apt-get install chromium)")
    opened = Browser(program)
    yield opened
    opened.close()
