"""The viewer's server: the page, the model, photographs and videos over HTTP on the own machine. Standard library only.

Whoever may ask knows the token in the printed address; requests for another host than the one served are refused, since a
foreign site may make its own name point here (DNS rebinding). Nothing is executed, and the only files written are videos in a
folder of the server's own, which goes with it.
"""

from __future__ import annotations

import contextlib
import errno
import hmac
import json
import secrets
import socket
import tempfile
import threading
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any
from urllib.parse import parse_qs, urlsplit

from nerfvol.config.parsers import box
from nerfvol.errors import InputError
from nerfvol.export.page import build_page
from nerfvol.files.atomic import explain_os_error
from nerfvol.viewer.shown import Shown, Video

LOOPBACK = ("127.0.0.1", "localhost", "::1")
MOST_PORTS = 20
MOST_BODY = 64 << 20
POLL_SECONDS = 20.0
_HEADERS = {
    "Cross-Origin-Opener-Policy": "same-origin",
    "Cross-Origin-Embedder-Policy": "require-corp",
    "Cross-Origin-Resource-Policy": "same-origin",
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",
}
_WAITING = (
    '<!doctype html><meta charset="utf-8"><meta http-equiv="refresh" content="2"><title>nerfvol</title>'
    "<body style='background:#0d0f12;color:#9aa3ad;font:16px system-ui;padding:2em'>There is nothing to see yet."
)


class ViewServer(ThreadingHTTPServer):
    """Serves ``shown`` at ``address``, an http:// address with the token, until :meth:`close`."""

    daemon_threads = True
    block_on_close = False
    allow_reuse_address = False  # a port that is taken is taken

    def __init__(self, shown: Shown, host: str = "127.0.0.1", port: int = 8080) -> None:
        """port: the first that is tried; 0: any that is free. InputError where none of the next few is free."""
        self.shown, self.token = shown, secrets.token_urlsafe(16)
        self.video: Video | None = None
        self.video_lock = threading.Lock()
        self._folder = tempfile.TemporaryDirectory(prefix="nerfvol-view-")
        self.folder = Path(self._folder.name)
        self.address_family = socket.AF_INET6 if ":" in host else socket.AF_INET
        for offset in range(MOST_PORTS if port else 1):
            try:
                super().__init__((host, port + offset), _Handler)
                break
            except OSError as error:
                if error.errno != errno.EADDRINUSE or offset + 1 == MOST_PORTS:
                    self._folder.cleanup()
                    raise InputError(f"cannot serve at {host}:{port + offset}: {explain_os_error(error)}") from error
        self.host, self.port = host, self.server_address[1]
        self.allowed = {f"{name}:{self.port}" for name in ((*LOOPBACK[:2], "[::1]") if host in LOOPBACK else (host,))}
        self.any_host = host in ("", "0.0.0.0", "::")  # noqa: S104  # asked for; only the token guards then
        self._thread: threading.Thread | None = None

    @property
    def address(self) -> str:
        """Where to look."""
        host = "127.0.0.1" if self.any_host else f"[{self.host}]" if ":" in self.host else self.host
        return f"http://{host}:{self.port}/?token={self.token}"

    def start(self) -> None:
        """Serve in a thread of its own."""
        self._thread = threading.Thread(target=self.serve_forever, kwargs={"poll_interval": 0.1}, daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Stop serving; a video on its way is given up."""
        if self._thread is not None:
            self.shutdown()
        self.server_close()
        if self.video is not None:
            self.video.stop()
        self._folder.cleanup()

    def handle_error(self, request: Any, client_address: Any) -> None:
        """A reader that has gone is no event."""


class _Handler(BaseHTTPRequestHandler):
    server: ViewServer  # type: ignore[assignment]  # pyright: ignore[reportIncompatibleVariableOverride]
    protocol_version = "HTTP/1.1"
    server_version, sys_version = "nerfvol", ""
    timeout = 60

    def log_message(self, format: str, *args: Any) -> None:
        """Requests are not printed."""

    def do_GET(self) -> None:
        """Everything that is read."""
        self._answer({
            "/": self._page, "/model": self._model, "/state": self._state, "/cameras": self._cameras,
            "/photograph": self._photograph, "/compare": self._compare, "/error": self._error, "/video": self._video,
            "/progress": self._progress,
        })  # fmt: skip

    def do_POST(self) -> None:
        """What starts work."""
        self._answer({"/render": self._render, "/stop": self._stop, "/pause": self._pause})

    def _answer(self, routes: dict[str, Any]) -> None:
        url = urlsplit(self.path)
        self.query = {key: values[-1] for key, values in parse_qs(url.query).items()}
        refused = self._refusal()
        if refused is not None:
            return self._send(HTTPStatus.FORBIDDEN, refused.encode(), "text/plain")
        route = routes.get(url.path)
        if route is None:
            return self._send(HTTPStatus.NOT_FOUND, b"there is no such thing here", "text/plain")
        try:
            route()
        except (LookupError, ValueError) as error:
            self._send(HTTPStatus.BAD_REQUEST, str(error).encode(), "text/plain; charset=utf-8")
        except (BrokenPipeError, ConnectionResetError):
            self.close_connection = True

    def _refusal(self) -> str | None:
        """Why this request is not answered."""
        server = self.server
        if not server.any_host and (self.headers.get("Host") or "").lower() not in server.allowed:
            return "this server answers only at its own address"
        origin = self.headers.get("Origin")
        if origin not in (None, "null") and urlsplit(origin).netloc.lower() != (self.headers.get("Host") or "").lower():
            return "requests from other sites are not answered"
        given = self.headers.get("X-Token") or ("" if self.command == "POST" else self.query.get("token", ""))
        if not hmac.compare_digest(given.encode(), server.token.encode()):
            return "the address lacks the token that nerfvol printed"
        return None

    def _send(self, status: int, body: bytes, kind: str, headers: dict[str, str] | None = None) -> None:
        if status >= 400:
            self.close_connection = True  # a body may be unread
        self.send_response(status)
        sent = {"Content-Type": kind, "Content-Length": str(len(body)), "Cache-Control": "no-store", **_HEADERS}
        for name, value in (sent | (headers or {})).items():
            self.send_header(name, value)
        if self.close_connection:
            self.send_header("Connection", "close")
        self.end_headers()
        with contextlib.suppress(BrokenPipeError, ConnectionResetError):
            self.wfile.write(body)

    def _json(self, value: Any) -> None:
        self._send(HTTPStatus.OK, json.dumps(value, allow_nan=False).encode(), "application/json")

    # ------------------------------------------------------------------ the model
    def _page(self) -> None:
        edition = self.server.shown.edition
        if edition is None:
            return self._send(HTTPStatus.OK, _WAITING.encode(), "text/html; charset=utf-8")
        page = build_page(edition.settings, edition.poster, None)
        self._send(HTTPStatus.OK, page.encode(), "text/html; charset=utf-8")

    def _model(self) -> None:
        edition = self.server.shown.edition
        if edition is None:
            raise LookupError("there is no model yet")
        tag = f'"{edition.version}"'
        if self.headers.get("If-None-Match") == tag:
            return self._send(HTTPStatus.NOT_MODIFIED, b"", "application/octet-stream", {"ETag": tag})
        headers = {"ETag": tag, "X-Version": str(edition.version)}
        self._send(HTTPStatus.OK, edition.data, "application/octet-stream", headers)

    def _state(self) -> None:
        self.server.shown.wait(self._number("version"), POLL_SECONDS)
        self._json(self.server.shown.state())

    def _pause(self) -> None:
        self.server.shown.pause(self._number("on") == 1)
        self._json(self.server.shown.state())

    # ------------------------------------------------------------------ photographs
    def _cameras(self) -> None:
        self._json(self.server.shown.cameras())

    def _photograph(self) -> None:
        self._send(HTTPStatus.OK, self.server.shown.photograph(self._number("index")), "image/jpeg")

    def _compare(self) -> None:
        psnr, _ = self.server.shown.compare(self._number("index"))
        self._json({"psnr": psnr})

    def _error(self) -> None:
        psnr, picture = self.server.shown.compare(self._number("index"))
        self._send(HTTPStatus.OK, picture, "image/jpeg", {"X-PSNR": f"{psnr:.2f}"})

    # ------------------------------------------------------------------ videos
    def _render(self) -> None:
        length = self.headers.get("Content-Length") or ""
        if not length.isdigit() or int(length) > MOST_BODY:
            raise ValueError(f"a path has at most {MOST_BODY} bytes and says how many")
        body = self.rfile.read(int(length))
        server, edition = self.server, self.server.shown.edition
        fps = self._number("fps")
        if edition is None or not 1 <= fps <= 120:
            raise ValueError("there is no model yet" if edition is None else f"fps must be 1 to 120, got {fps}")
        with server.video_lock:
            if server.video is not None and not server.video.state()["finished"]:
                raise ValueError("a video is being drawn already")
            server.video = Video(server.shown, edition, body, fps, server.folder, self._crop())
        self._json(server.video.state())

    def _stop(self) -> None:
        if self.server.video is not None:
            self.server.video.stop()
        self._json({})

    def _progress(self) -> None:
        if self.server.video is None:
            raise LookupError("no video was asked for")
        self._json(self.server.video.state())

    def _video(self) -> None:
        video = self.server.video
        if video is None or not video.state()["finished"] or video.fault:
            raise LookupError("there is no video yet")
        headers = {"Content-Disposition": 'attachment; filename="path.mp4"'}
        self._send(HTTPStatus.OK, video.file.read_bytes(), "video/mp4", headers)

    def _crop(self) -> tuple[float, ...] | None:
        """The box that the page shows alone, None where it shows all."""
        return box(self.query.get("crop"))

    def _number(self, name: str) -> int:
        text = self.query.get(name, "")
        if not text.isascii() or not text.isdigit() or len(text) > 9:
            raise ValueError(f"{name} must be a whole number, got {text[:20]!r}")
        return int(text)
