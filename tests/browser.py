"""Show pages in headless Chromium, which is controlled through a pipe with the DevTools protocol."""

from __future__ import annotations

import base64
import json
import os
import select
import shutil
import subprocess
import tempfile
import time
from pathlib import Path
from types import TracebackType
from typing import Any, Self

NAMES = ("chromium", "chromium-browser", "google-chrome", "chrome")
# The time limit of a request to the browser. Answers take milliseconds, but starting it takes seconds.
TIMEOUT_S = 60.0
OPTIONS = (
    "--headless=new",
    "--no-sandbox",
    "--disable-gpu",
    "--disable-extensions",
    "--no-first-run",
    "--hide-scrollbars",
    "--remote-debugging-pipe",
)

PHONE_PX, DESK_PX = 390, 1280
# This script lists what is wrong with the page as shown: low contrast (WCAG 2 AA requires 4.5, or 3 for large
# letters), a page wider than the screen, and pictures without content. To judge the content of a picture,
# the script draws it at a small size and counts its colours.
FAULTS = """(async () => {
  const found = [], channel = v => (v /= 255) <= .04045 ? v / 12.92 : ((v + .055) / 1.055) ** 2.4;
  const light = ([r, g, b]) => .2126 * channel(r) + .7152 * channel(g) + .0722 * channel(b);
  const rgb = text => text.match(/[\\d.]+/g).map(Number);
  const over = (colour, ground) => [0, 1, 2].map(i => ground[i] + (colour[3] ?? 1) * (colour[i] - ground[i]));
  const dark = matchMedia("(prefers-color-scheme: dark)").matches;
  const paper = e => e ? over(rgb(getComputedStyle(e).backgroundColor), paper(e.parentElement))
    : dark ? [18, 18, 18] : [255, 255, 255];
  const walk = document.createTreeWalker(document.body, NodeFilter.SHOW_TEXT);
  for (let node; node = walk.nextNode();) {
    const element = node.parentElement;
    const seen = element.checkVisibility({opacityProperty: true, visibilityProperty: true})
      && element.getBoundingClientRect().right > 0;
    if (!node.textContent.trim() || !seen || element.tagName === "SCRIPT") continue;
    const style = getComputedStyle(element), size = parseFloat(style.fontSize);
    const ground = paper(element), ink = over(rgb(style.color), ground);
    const [a, b] = [light(ink), light(ground)].sort((x, y) => y - x);
    const wanted = size >= 24 || (size >= 18.66 && style.fontWeight >= 700) ? 3 : 4.5;
    if ((a + .05) / (b + .05) < wanted) found.push(`contrast of "${node.textContent.trim().slice(0, 40)}"`);
  }
  if (document.documentElement.scrollWidth > innerWidth) found.push("wider than the screen");
  for (const image of document.images) {
    if (!image.complete || !image.naturalWidth) { found.push("picture not decoded"); continue; }
    if (!image.checkVisibility() || image.clientHeight < 4) { found.push("picture not shown"); continue; }
    const canvas = document.createElement("canvas"); canvas.width = canvas.height = 64;
    const context = canvas.getContext("2d"); context.drawImage(image, 0, 0, 64, 64);
    const colours = new Set(new Uint32Array(context.getImageData(0, 0, 64, 64).data.buffer));
    if (colours.size < 8) found.push("picture without content");
  }
  return found;
})()"""


def browser_path() -> str | None:
    """Return the path of this machine's browser, or None."""
    return next((path for name in NAMES if (path := shutil.which(name))), None)


class Browser:
    """Control one Chromium with one page."""

    def __enter__(self) -> Self:
        path = browser_path()
        assert path is not None
        self._profile = tempfile.TemporaryDirectory(ignore_cleanup_errors=True)
        to_read, self._write = os.pipe()
        self._read, to_write = os.pipe()
        # The browser reads commands from descriptor 3 and writes its answers to 4.
        wire = 'exec 3<&"$1" 4>&"$2"; shift 2; exec "$@"'
        self._process = subprocess.Popen(
            ["bash", "-c", wire, "wire", str(to_read), str(to_write), path, *OPTIONS,
             f"--user-data-dir={self._profile.name}", "about:blank"],
            pass_fds=(to_read, to_write), stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
        )  # fmt: skip
        os.close(to_read)
        os.close(to_write)
        self._buffer, self._number, self._session = b"", 0, ""
        self.errors: list[str] = []
        (target,) = [one for one in self.ask("Target.getTargets")["targetInfos"] if one["type"] == "page"]
        self._session = self.ask("Target.attachToTarget", targetId=target["targetId"], flatten=True)[
            "sessionId"
        ]
        for domain in ("Page", "Runtime", "Log"):
            self.ask(f"{domain}.enable")
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._process.kill()
        self._process.wait()
        os.close(self._write)
        os.close(self._read)
        self._profile.cleanup()

    def show(self, page: Path | str, width_px: int, dark: bool) -> None:
        """Load a page from a file or an address. Afterwards, ``errors`` lists the errors that the page
        reported.
        """
        self.errors = []
        self.screen(width_px, dark)
        self._loaded = False
        self.ask("Page.navigate", url=page if isinstance(page, str) else page.resolve().as_uri())
        while not self._loaded:
            self._take(self._receive())
        # The browser would decode pictures far down the page only when scrolled to. Decode all of them now.
        self.run("Promise.all([...document.images].map(i => i.decode().catch(() => 0))).then(() => 1)")

    def screen(self, width_px: int, dark: bool) -> None:
        """Set the size of the screen and its colour scheme, light or dark."""
        self.ask(
            "Emulation.setDeviceMetricsOverride", width=width_px, height=844 if width_px < 600 else 800,
            deviceScaleFactor=1, mobile=False,
        )  # fmt: skip
        scheme = {"name": "prefers-color-scheme", "value": "dark" if dark else "light"}
        self.ask("Emulation.setEmulatedMedia", features=[scheme])

    def run(self, script: str) -> Any:
        """Evaluate a JavaScript expression in the page and return its value."""
        answer = self.ask("Runtime.evaluate", expression=script, returnByValue=True, awaitPromise=True)
        assert "exceptionDetails" not in answer, answer["exceptionDetails"]
        return answer["result"].get("value")

    def picture(self, file: Path) -> None:
        """Write a screenshot of the whole page to a PNG file."""
        height = self.run("document.documentElement.scrollHeight")
        width = self.run("innerWidth")
        clip = {"x": 0, "y": 0, "width": width, "height": min(height, 16000), "scale": 1}
        answer = self.ask("Page.captureScreenshot", captureBeyondViewport=True, clip=clip)
        file.write_bytes(base64.b64decode(answer["data"]))

    def ask(self, method: str, **parameters: Any) -> dict[str, Any]:
        """Send one command of the protocol and return its answer."""
        self._number += 1
        message: dict[str, Any] = {"id": self._number, "method": method, "params": parameters}
        if self._session:
            message["sessionId"] = self._session
        os.write(self._write, json.dumps(message).encode() + b"\0")
        while True:
            received = self._receive()
            if received.get("id") == self._number:
                assert "error" not in received, received["error"]
                return received["result"]
            self._take(received)

    def _take(self, event: dict[str, Any]) -> None:
        match event.get("method"):
            case "Page.loadEventFired":
                self._loaded = True
            case "Runtime.exceptionThrown":
                self.errors.append(str(event["params"]["exceptionDetails"].get("text")))
            case "Runtime.consoleAPICalled" if event["params"]["type"] in ("error", "warning"):
                self.errors.append(str(event["params"]["args"]))
            case "Log.entryAdded" if event["params"]["entry"]["level"] == "error":
                self.errors.append(event["params"]["entry"]["text"])

    def _receive(self) -> dict[str, Any]:
        until = time.monotonic() + TIMEOUT_S
        while b"\0" not in self._buffer:
            ready, _, _ = select.select([self._read], [], [], max(0.0, until - time.monotonic()))
            assert ready, f"the browser did not answer within {TIMEOUT_S:g} s"
            part = os.read(self._read, 1 << 16)
            assert part, "the browser has exited"
            self._buffer += part
        line, _, self._buffer = self._buffer.partition(b"\0")
        return json.loads(line)
