"""A page on this machine only: `/` is the page, `/state.json` what it shows, `/picture.jpg` the newest dry image."""

from __future__ import annotations

import json
import math
import threading
import time
from collections.abc import Callable
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any

from rainstereo.apps.run_record import jsonable

LOOPBACK = "127.0.0.1"
_LOCAL = ("127.0.0.1", "localhost", "[::1]")


class Served:
    """What the page may fetch; set by one thread, read by those that answer."""

    def __init__(self, page: str) -> None:
        self._lock = threading.Lock()
        self._page = page.encode()
        self._state = b"{}"
        self._picture = b""
        self._asked = -math.inf

    def show(self, state: object, picture: bytes | None = None) -> None:
        """Replace the state, and the picture (JPEG) where one is given."""
        data = json.dumps(jsonable(state), allow_nan=False).encode()
        with self._lock:
            self._state = data
            if picture is not None:
                self._picture = picture

    def looked_at(self, seconds: float) -> bool:
        """Whether a page has asked for the state within that time."""
        with self._lock:
            return time.monotonic() - self._asked < seconds

    def answer(self, path: str) -> tuple[str, bytes] | None:
        """Content type and body, or None for what is not there."""
        with self._lock:
            if path in ("/", "/index.html"):
                return "text/html; charset=utf-8", self._page
            if path == "/state.json":
                self._asked = time.monotonic()
                return "application/json", self._state
            if path == "/picture.jpg" and self._picture:
                return "image/jpeg", self._picture
        return None


class PageServer:
    """Serves `Served` on the loopback interface until it is closed. ValueError where the port is taken."""

    def __init__(self, served: Served, port: int) -> None:
        if not 0 <= port <= 65535:
            raise ValueError(f"--port {port} was given; expected 0 (any that is free) to 65535")
        try:
            self._server = ThreadingHTTPServer((LOOPBACK, port), _handler(served))
        except OSError as error:
            raise ValueError(
                f"port {port} of this machine cannot be used ({error.strerror or error}): another capture may be "
                "running; give --port 0 for any that is free"
            ) from error
        self._server.daemon_threads = True
        self._thread = threading.Thread(target=self._server.serve_forever, kwargs={"poll_interval": 0.1}, daemon=True)
        self._thread.start()

    @property
    def url(self) -> str:
        """Where a browser on this machine finds the page."""
        return f"http://{LOOPBACK}:{self._server.server_address[1]}/"

    def close(self) -> None:
        """Stop answering and free the port."""
        self._server.shutdown()
        self._server.server_close()
        self._thread.join(5)

    def __enter__(self) -> PageServer:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def _handler(served: Served) -> Callable[..., BaseHTTPRequestHandler]:
    class Handler(BaseHTTPRequestHandler):
        server_version, sys_version = "rainstereo", ""
        timeout = 10

        def do_GET(self) -> None:
            self._reply(True)

        def do_HEAD(self) -> None:
            self._reply(False)

        def log_message(self, format: str, *arguments: Any) -> None:  # noqa: A002 - the base class names it so
            """Nothing: the terminal belongs to the capture."""

        def _reply(self, body: bool) -> None:
            host = self.headers.get("Host", LOOPBACK).rpartition(":")[0] or self.headers.get("Host", LOOPBACK)
            if host not in _LOCAL:  # a page from elsewhere that had its name point here
                self.send_error(403, "this page is for this machine only")
                return
            found = served.answer(self.path.split("?", 1)[0])
            if found is None:
                self.send_error(404)
                return
            kind, data = found
            self.send_response(200)
            self.send_header("Content-Type", kind)
            self.send_header("Content-Length", str(len(data)))
            self.send_header("Cache-Control", "no-store")
            self.send_header("X-Content-Type-Options", "nosniff")
            self.send_header(
                "Content-Security-Policy",
                "default-src 'none'; connect-src 'self'; img-src 'self' data:; style-src 'unsafe-inline'; "
                "script-src 'unsafe-inline'",
            )
            self.end_headers()
            if body:
                self.wfile.write(data)

    return Handler
