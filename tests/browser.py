"""A page in headless Chromium, driven through its debugging pipe: no driver, no port."""

import base64
import json
import os
import shutil
import subprocess
import tempfile
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
import torch
from PIL import Image

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")


class Page:
    """A file or an address that is open in a browser of its own, with a window of so many pixels; a context.

    Args:
        place: the file, or the address.
        width: of the window.
        height: of the window.

    Attributes:
        requests: addresses that the page asked for, its own among them.
        complaints: errors that it raised, or that the browser logged about it.
    """

    def __init__(self, place: Path | str, width: int = 1000, height: int = 900) -> None:
        self.requests: list[str] = []
        self.complaints: list[str] = []
        self._size, self._asked = (width, height), 0
        self._address = place if isinstance(place, str) else place.resolve().as_uri()

    def __enter__(self) -> "Page":
        commands, answers = os.pipe(), os.pipe()
        self._profile = tempfile.TemporaryDirectory(ignore_cleanup_errors=True)
        options = [
            "--headless",
            "--no-sandbox",
            "--disable-gpu",
            "--use-angle=swiftshader",
            "--enable-unsafe-swiftshader",
        ]
        options += ["--remote-debugging-pipe", f"--user-data-dir={self._profile.name}", "--hide-scrollbars"]
        # The browser reads commands from descriptor 3 and writes answers to 4.
        script = f'exec "$0" "$@" 3<&{commands[0]} 4>&{answers[1]}'
        self._process = subprocess.Popen(
            ["bash", "-c", script, str(CHROMIUM), *options],
            pass_fds=(commands[0], answers[1]), stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
        )  # fmt: skip
        os.close(commands[0])
        os.close(answers[1])
        self._out, self._in = open(commands[1], "wb", buffering=0), open(answers[0], "rb")
        self._session: dict[str, str] = {}
        target = self("Target.createTarget", url="about:blank")["targetId"]
        self._session["sessionId"] = self("Target.attachToTarget", targetId=target, flatten=True)["sessionId"]
        for domain in ("Page", "Network", "Runtime", "Log"):
            self(f"{domain}.enable")
        width, height = self._size
        self("Emulation.setDeviceMetricsOverride", width=width, height=height, deviceScaleFactor=1, mobile=False)
        self._loaded = False
        self("Page.navigate", url=self._address)
        while not self._loaded:
            self._read()
        return self

    def __exit__(self, *error: object) -> None:
        self._out.close()
        self._process.kill()
        self._process.wait()
        self._in.close()
        self._profile.cleanup()

    def __call__(self, method: str, **parameters: Any) -> dict[str, Any]:
        """Send a command of the DevTools protocol and return its result."""
        self._asked += 1
        message = {"id": self._asked, "method": method, "params": parameters, **self._session}
        self._out.write(json.dumps(message).encode() + b"\0")
        while (answer := self._read()).get("id") != self._asked:
            pass
        if "error" in answer:
            raise RuntimeError(f"{method}: {answer['error']}")
        return answer["result"]

    def run(self, script: str) -> Any:
        """Return the value of JavaScript in the page; a promise is waited for."""
        result = self("Runtime.evaluate", expression=script, returnByValue=True, awaitPromise=True)
        if "exceptionDetails" in result:
            raise RuntimeError(f"{script}: {result['exceptionDetails']}")
        return result["result"].get("value")

    def picture(self) -> torch.Tensor:
        """Return the window as colors (3, H, W) in [0, 1]."""
        with Image.open(BytesIO(base64.b64decode(self("Page.captureScreenshot")["data"]))) as file:
            return torch.from_numpy(np.array(file.convert("RGB"))).permute(2, 0, 1) / 255

    def _read(self) -> dict[str, Any]:
        """Read a message, and remember what it says of requests and complaints."""
        text = bytearray()
        while (letter := self._in.read(1)) != b"\0":
            if not letter:
                raise RuntimeError(f"the browser ended: {self._process.wait()}")
            text += letter
        message = json.loads(text)
        parameters = message.get("params", {})
        match message.get("method"):
            case "Network.requestWillBeSent":
                self.requests.append(parameters["request"]["url"])
            case "Runtime.exceptionThrown":
                self.complaints.append(json.dumps(parameters)[:500])
            case "Log.entryAdded" if parameters["entry"]["level"] == "error":
                self.complaints.append(parameters["entry"]["text"])
            case "Page.loadEventFired":
                self._loaded = True
        return message
