"""The documentation's site is built without a warning and without a network, and searches itself."""

import functools
import http.server
import os
import subprocess
import sys
import threading
from pathlib import Path

import pytest
from support.browser import browsing
from support.missing import import_but_fail_in_ci

ROOT = Path(__file__).resolve().parents[2]
LIMIT_S = 900
pytestmark = pytest.mark.timeout(LIMIT_S)


@pytest.fixture(scope="module")
def site(tmp_path_factory):
    """Build the site of what is here, with its examples not executed, and return its folder."""
    import_but_fail_in_ci("sphinx")
    out = tmp_path_factory.mktemp("site")
    options = ["-W", "--keep-going", "-q", "-D", "plot_gallery=0", "-d", out / "doctrees"]
    nowhere = "http://127.0.0.1:9"  # nothing listens there
    done = subprocess.run(
        [sys.executable, "-m", "sphinx", *options, ROOT / "docs", out / "html"],
        cwd=ROOT,
        env={**os.environ, "http_proxy": nowhere, "https_proxy": nowhere, "PYTHONPATH": str(ROOT)},
        capture_output=True,
        text=True,
        timeout=LIMIT_S,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    return out / "html"


def test_all_pages_are_there(site):
    pages = {page.relative_to(ROOT / "docs").with_suffix(".html") for page in (ROOT / "docs").glob("*.md")}
    assert pages <= {page.relative_to(site) for page in site.rglob("*.html")}
    decoder = (site / "generated" / "colorphase.Decoder.html").read_text(encoding="utf-8")
    assert "decode_all" in decoder and "DeviceNotReady" in decoder
    assert "--baseline" in (site / "commands.html").read_text(encoding="utf-8")
    assert "smoothing_px" in (site / "settings.html").read_text(encoding="utf-8")
    assert len(list((site / "gallery").glob("*.html"))) <= 1 + 12  # its index, and a dozen examples


def test_search_needs_no_other_host(site):
    class Handler(http.server.SimpleHTTPRequestHandler):
        def log_message(self, *_):
            """Print nothing."""

        def do_GET(self):
            """Send a file; a browser requests an icon by itself, and there is none."""
            if self.path == "/favicon.ico":
                self.send_response(204)
                self.end_headers()
            else:
                super().do_GET()

    handler = functools.partial(Handler, directory=site)
    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), handler) as server, browsing() as page:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        page.goto(f"http://127.0.0.1:{server.server_port}/README.html")
        page.get_by_placeholder("Search").fill("crosstalk")
        page.keyboard.press("Enter")
        page.locator("#search-results li a", has_text="The method").first.click()
        assert page.title().startswith("The method")
        server.shutdown()
