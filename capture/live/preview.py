"""The live display in a browser on this machine: picture and gauges, served on 127.0.0.1 and nowhere else.

Who may look: a program on this machine that knows the address with its random part. The server listens on
the loopback address only, answers only requests whose Host is that address (a page elsewhere that has its
own name resolve to 127.0.0.1 gets nothing), allows no other origin, and only reads.

The picture is that of unlit frames (`steady_picture`), so that the screen does not flash.
"""

from __future__ import annotations

import hmac
import json
import secrets
import threading
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from types import TracebackType
from typing import Self

import cv2
import numpy as np
from numpy.typing import NDArray

from capture.devices.bench import Clock, MonotonicClock
from capture.errors import DeviceError
from capture.live.preview_page import page
from capture.live.state import LiveState
from capture.live.steady_picture import SteadyPicture

ADDRESS = "127.0.0.1"
_JPEG_QUALITY = 82
_IDLE_S = 2.0  # a connection that says nothing is closed
_POLL_S = 0.1  # how soon a stop is noticed


class PreviewServer:
    """Serves the newest state and picture; a context manager that stops it.

    `update` may be called from another thread than the one that made it.
    """

    def __init__(self, port: int = 0, *, rotation_deg: int = 0, clock: Clock | None = None) -> None:
        """Starts serving.

        Args:
            port: 0 = any free one.
            rotation_deg: clockwise turn that shows the pictures upright: 0, 90, 180, 270.
            clock: of the pictures' pace.

        Raises:
            DeviceError: the port is taken or not allowed.
            ValueError: another rotation.
        """
        if rotation_deg not in (0, 90, 180, 270):
            raise ValueError(f"rotation_deg is {rotation_deg}; it must be 0, 90, 180 or 270")
        self._turns, self._clock = rotation_deg // 90, clock or MonotonicClock()
        self._lock = threading.Lock()
        self._state = LiveState()
        self._steady = SteadyPicture()
        self._jpeg: tuple[int, bytes] = (0, b"")
        self._token = secrets.token_urlsafe(18)
        try:
            self._server = _Server(self, port)
        except (OSError, OverflowError) as error:
            reason = error.strerror if isinstance(error, OSError) and error.strerror else error
            raise DeviceError(
                f"The preview cannot listen on {ADDRESS} port {port} ({reason}); choose another port, or 0 "
                "for any free one."
            ) from error
        self._thread: threading.Thread | None = threading.Thread(
            target=self._server.serve_forever, args=(_POLL_S,), name="preview", daemon=True
        )
        self._thread.start()

    @property
    def port(self) -> int:
        """That it listens on."""
        return int(self._server.server_address[1])

    @property
    def url(self) -> str:
        """Of the page; whoever has it can look."""
        return f"http://{ADDRESS}:{self.port}/{self._token}/"

    def update(self, state: LiveState, picture: NDArray[np.uint8]) -> None:
        """What is to be shown from now on.

        Args:
            state: of the moment.
            picture: [h, w, 3] RGB or [h, w] uint8, small, of the frame that the state's last label is about.
        """
        label = state.labels[-1] if state.labels else "unknown"
        with self._lock:
            self._state = state
            self._steady.offer(picture, label, self._clock.now_s())

    def close(self) -> None:
        """Stops serving; no thread is left. Harmless when repeated."""
        if self._thread is not None:
            self._server.shutdown()
            self._server.server_close()
            self._thread.join()
            self._thread = None

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def _state_json(self) -> bytes:
        with self._lock:
            content = self._state.to_json() | {"picture": self._steady.number}
        return json.dumps(content).encode()

    def _picture_jpeg(self) -> bytes:
        """The shown picture; made only when somebody asks for it."""
        with self._lock:
            number, picture = self._steady.number, self._steady.picture
            if picture is None or self._jpeg[0] == number:
                return self._jpeg[1]
        upright = np.ascontiguousarray(np.rot90(picture, -self._turns))
        bgr = upright if upright.ndim == 2 else cv2.cvtColor(upright, cv2.COLOR_RGB2BGR)
        _, encoded = cv2.imencode(".jpg", bgr, [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY])
        with self._lock:
            self._jpeg = (number, encoded.tobytes())
            return self._jpeg[1]


class _Server(ThreadingHTTPServer):
    """Waits for its requests' threads when it closes; each lasts at most `_IDLE_S`."""

    daemon_threads = False
    block_on_close = True

    def __init__(self, preview: PreviewServer, port: int) -> None:
        self.preview = preview
        super().__init__((ADDRESS, port), _Handler)

    def handle_error(self, request: object, client_address: object) -> None:
        """A browser that goes away in the middle of an answer is nothing to report."""


class _Handler(BaseHTTPRequestHandler):
    """GET of the page, the state, the picture; everything else is refused."""

    server: _Server
    timeout = _IDLE_S
    server_version = "preview"
    sys_version = ""

    def do_GET(self) -> None:
        preview = self.server.preview
        hosts = {f"{name}:{preview.port}" for name in (ADDRESS, "localhost")}
        if self.headers.get("Host", "").lower() not in hosts:
            self._answer(HTTPStatus.FORBIDDEN, "text/plain", b"not for this host\n")
            return
        token, _, name = self.path.partition("?")[0].removeprefix("/").partition("/")
        if not hmac.compare_digest(token.encode(), preview._token.encode()):
            self._answer(HTTPStatus.NOT_FOUND, "text/plain", b"the address is incomplete\n")
        elif name == "":
            nonce = secrets.token_urlsafe(12)
            self._answer(HTTPStatus.OK, "text/html; charset=utf-8", page(nonce).encode(), nonce)
        elif name == "state.json":
            self._answer(HTTPStatus.OK, "application/json", preview._state_json())
        elif name == "picture.jpg":
            jpeg = preview._picture_jpeg()
            self._answer(HTTPStatus.OK if jpeg else HTTPStatus.NO_CONTENT, "image/jpeg", jpeg)
        else:
            self._answer(HTTPStatus.NOT_FOUND, "text/plain", b"nothing here\n")

    def _answer(self, status: HTTPStatus, kind: str, content: bytes, nonce: str = "") -> None:
        script = f"script-src 'nonce-{nonce}'; style-src 'nonce-{nonce}'; " if nonce else ""
        self.send_response(status)
        self.send_header("Content-Type", kind)
        self.send_header("Content-Length", str(len(content)))
        self.send_header("Cache-Control", "no-store")
        self.send_header(
            "Content-Security-Policy",
            f"default-src 'none'; {script}img-src 'self'; connect-src 'self'; frame-ancestors 'none'",
        )
        self.send_header("Cross-Origin-Resource-Policy", "same-origin")
        self.send_header("Referrer-Policy", "no-referrer")
        self.send_header("X-Content-Type-Options", "nosniff")
        self.end_headers()
        self.wfile.write(content)

    def log_message(self, format: str, *args: object) -> None:
        """Keeps quiet: the terminal belongs to the panel."""
