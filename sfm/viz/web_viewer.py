"""Rerun's web viewer, served so that nothing leaves this machine.

The page that rerun-sdk carries fetches a font and a script of statistics from the internet, and its program
reports events from within the browser, where no switch reaches (found in 0.41). So the page is not taken from
Rerun's server: its files are, once, over loopback; then they and the scene are served from here with a content security
policy under which the browser asks no other host for anything. Requests that do not name this machine as
their host are refused, so that no foreign page can read the scene through a name that it points here.
"""

from __future__ import annotations

import contextlib
import socket
import subprocess
import time
import urllib.request
from collections.abc import Iterator, Mapping, Sequence
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

from sfm.core.errors import SfmError

LOOPBACK = "127.0.0.1"
POLICY = "default-src 'self' 'unsafe-inline' 'unsafe-eval' 'wasm-unsafe-eval' blob: data:; base-uri 'none'"

_TYPES = {
    "index.html": "text/html; charset=utf-8",
    "re_viewer.js": "text/javascript",
    "re_viewer_bg.wasm": "application/wasm",
    "favicon.ico": "image/x-icon",
}
_SCENE = "scene.rrd"
_PATIENCE_S = 30.0


def viewer_files(launcher: Sequence[str]) -> dict[str, bytes]:
    """The files of the web viewer, from a server of Rerun's that runs on loopback for a moment.

    Args:
        launcher: the command that starts Rerun's program.
    Raises:
        SfmError: it does not serve them.
    """
    port = _free_port()
    options = ["--serve-web", "--bind", LOOPBACK, "--port", str(_free_port()), "--web-viewer-port", str(port)]
    server = subprocess.Popen([*launcher, *options], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    try:
        _wait_for(port, server)
        return {name: _fetch(f"http://{LOOPBACK}:{port}/{name}") for name in _TYPES}
    except OSError as error:
        raise SfmError(f"Rerun's web viewer could not be read: {error}", remedy="try without --web") from error
    finally:
        server.terminate()
        server.wait()


@contextlib.contextmanager
def scene_server(
    scene: Path, files: Mapping[str, bytes], *, port: int = 0
) -> Iterator[tuple[ThreadingHTTPServer, str]]:
    """A server of the viewer and a scene on loopback, not yet running, and the address to open.

    Args:
        port: 0 takes a free one.
    """
    server = ThreadingHTTPServer((LOOPBACK, port), _handler(scene, files))
    server.daemon_threads = True
    host = f"http://{LOOPBACK}:{server.server_address[1]}"
    try:
        yield server, f"{host}/?url={host}/{_SCENE}"
    finally:
        server.server_close()


def _handler(scene: Path, files: Mapping[str, bytes]) -> type[BaseHTTPRequestHandler]:
    class Handler(BaseHTTPRequestHandler):
        """Gives out the viewer's files and the scene, and nothing else."""

        def do_GET(self) -> None:
            self._answer(with_body=True)

        def do_HEAD(self) -> None:
            self._answer(with_body=False)

        def _answer(self, *, with_body: bool) -> None:
            name = self.path.split("?")[0].lstrip("/") or "index.html"
            if self.headers.get("Host", "").rsplit(":", 1)[0] not in (LOOPBACK, "localhost"):
                self.send_error(HTTPStatus.FORBIDDEN)
                return
            if name != _SCENE and name not in files:
                self.send_error(HTTPStatus.NOT_FOUND)
                return
            body = scene.read_bytes() if name == _SCENE else files[name]
            self.send_response(HTTPStatus.OK)
            self.send_header("Content-Type", _TYPES.get(name, "application/octet-stream"))
            self.send_header("Content-Length", str(len(body)))
            self.send_header("Content-Security-Policy", POLICY)
            self.send_header("Cache-Control", "no-store")
            self.end_headers()
            if with_body:
                self.wfile.write(body)

        def log_message(self, format: str, *args: object) -> None:
            """Says nothing."""

    return Handler


def _free_port() -> int:
    with socket.socket() as probe:
        probe.bind((LOOPBACK, 0))
        return int(probe.getsockname()[1])


def _wait_for(port: int, server: subprocess.Popen[bytes]) -> None:
    deadline = time.monotonic() + _PATIENCE_S
    while True:
        try:
            socket.create_connection((LOOPBACK, port), timeout=1).close()
            return
        except OSError:
            if server.poll() is not None or time.monotonic() > deadline:
                raise
        time.sleep(0.05)


def _fetch(address: str) -> bytes:
    direct = urllib.request.build_opener(urllib.request.ProxyHandler({}))
    with direct.open(address, timeout=_PATIENCE_S) as reply:
        return reply.read()
