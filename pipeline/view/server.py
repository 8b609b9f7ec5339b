"""The viewer's private server: on loopback, under a random path, for the page's own requests only."""

import hmac
import json
import secrets
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from urllib.parse import parse_qs, urlsplit

from pipeline.errors import SettingsError
from pipeline.view.page import page
from pipeline.view.subjects import Subject
from tikernels.errors import Error

_HOST = "127.0.0.1"
# Host names of loopback, or of the near end of a tunnel. Any other name was made to resolve to loopback by a foreign
# page.
_NAMES = ("127.0.0.1", "localhost", "[::1]")
# Idle connections are closed after this time, s.
_SILENCE_S = 60.0
# The longest wait for a live frame, s.
_LIVE_S = 5.0


class ViewServer(ThreadingHTTPServer):
    """Serve the page of a subject until closed.

    Parameters
    ----------
    subject : Subject
        The frames to show.
    port : int
        Port on loopback; 0: a free one.

    Attributes
    ----------
    address : str
        URL of the page.

    Raises
    ------
    SettingsError
        The port is in use.
    """

    daemon_threads = True
    allow_reuse_address = True

    def __init__(self, subject: Subject, port: int = 0) -> None:
        self.subject = subject
        self.token = secrets.token_urlsafe(24)
        try:
            super().__init__((_HOST, port), _Handler)
        except OSError as error:
            raise SettingsError(f"port {port} cannot be used ({error.strerror}): give another --port") from None
        self.address = f"http://{_HOST}:{self.server_port}/{self.token}/"

    def handle_error(self, request: object, client_address: object) -> None:
        """Ignore browsers that disconnect."""


class _Handler(BaseHTTPRequestHandler):
    server: ViewServer
    protocol_version = "HTTP/1.1"
    timeout = _SILENCE_S

    def do_GET(self) -> None:
        parts = urlsplit(self.path)
        _, token, *route = parts.path.split("/")
        if not self._is_own_page() or not hmac.compare_digest(token.encode(), self.server.token.encode()):
            self._answer(404, b"", "text/plain")
            return
        asked = {name: values[-1] for name, values in parse_qs(parts.query).items()}
        try:
            self._answer_route(route, asked)
        except (Error, ValueError) as error:
            line = str(error) if isinstance(error, Error) else "unknown request"
            self._answer(422, json.dumps({"error": line}).encode(), "application/json")

    def _answer_route(self, route: list[str], asked: dict[str, str]) -> None:
        subject = self.server.subject
        names, step = asked.get("fields", "").split(","), int(asked.get("step", 1))
        match route:
            case [""]:
                self._answer(200, page().encode(), "text/html; charset=utf-8")
            case ["about"]:
                self._answer(200, json.dumps(subject.about()).encode(), "application/json")
            case ["frame", place]:
                self._answer(200, subject.frame(int(place), names).pack(step), "application/octet-stream")
            case ["live"]:
                frame = subject.next(int(asked.get("after", -1)), names, _LIVE_S)
                if frame is None:
                    self._answer(204, b"", "application/octet-stream")
                else:
                    self._answer(200, frame.pack(step), "application/octet-stream")
            case _:
                raise ValueError

    def _is_own_page(self) -> bool:
        """Return whether a request comes from this page and not from a foreign one, or through a foreign host name."""
        host = self.headers.get("Host", "")
        if host.rpartition(":")[0] not in _NAMES and host not in _NAMES:
            return False
        origin = self.headers.get("Origin")
        site = self.headers.get("Sec-Fetch-Site", "none")
        return origin in (None, f"http://{host}") and site in ("none", "same-origin")

    def _answer(self, status: int, body: bytes, kind: str) -> None:
        self.send_response(status)
        self.send_header("Content-Type", kind)
        self.send_header("Content-Length", str(len(body)))
        self.send_header("Cache-Control", "no-store")
        self.send_header("Referrer-Policy", "no-referrer")
        self.send_header("X-Content-Type-Options", "nosniff")
        self.send_header("Cross-Origin-Resource-Policy", "same-origin")
        self.send_header("Content-Security-Policy", "frame-ancestors 'none'")
        self.end_headers()
        self.wfile.write(body)

    def log_message(self, format: str, *args: object) -> None:
        """Log nothing: request lines contain the token."""
