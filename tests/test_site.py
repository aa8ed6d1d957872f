"""Check every page of the documentation site in a browser, at two widths and in light and dark colours."""

from __future__ import annotations

import functools
import http.server
import importlib.util
import os
import subprocess
import sys
import threading
from pathlib import Path

import pytest

from tests.browser import DESK_PX, FAULTS, PHONE_PX, Browser, browser_path

ROOT = Path(__file__).parents[1]
# A script of the site switches its colours, with a transition that takes time.
COLOURED = "new Promise(done => setTimeout(() => done(document.body.dataset.mdColorScheme), 300))"


class Quiet(http.server.SimpleHTTPRequestHandler):
    def log_message(self, *words: object) -> None:
        pass


@pytest.mark.long
def test_every_page_of_the_site_is_sound_on_every_screen(tmp_path):
    if browser_path() is None:
        pytest.skip("Chromium is not installed on this machine")
    if importlib.util.find_spec("mkdocs") is None:
        pytest.skip("mkdocs is not installed; run make docs to install it")
    command = [sys.executable, "-m", "mkdocs", "build", "--quiet", "--strict", "--site-dir", str(tmp_path)]
    subprocess.run(command, cwd=ROOT, check=True, env=os.environ | {"NO_MKDOCS_2_WARNING": "1"})
    # Serve the pages over HTTP. In pages opened as files, scripts cannot read pictures, and the search fails.
    serve = functools.partial(Quiet, directory=str(tmp_path))
    found = {}
    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), serve) as server, Browser() as browser:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        pages = [page for page in sorted(tmp_path.rglob("*.html")) if "files" not in page.parts]
        assert len(pages) > 30
        for page in pages:
            for width_px in (DESK_PX, PHONE_PX):
                address = f"http://127.0.0.1:{server.server_port}/{page.relative_to(tmp_path).as_posix()}"
                browser.show(address, width_px, dark=False)
                for dark in (False, True):
                    browser.screen(width_px, dark)
                    assert browser.run(COLOURED) == ("slate" if dark else "default")
                    name = f"{page.stem}, {width_px} px, {'dark' if dark else 'light'}"
                    found[name] = browser.run(FAULTS) + browser.errors
        server.shutdown()
    assert {name: faults for name, faults in found.items() if faults} == {}
