from __future__ import annotations

import http.client
import threading
from collections.abc import Iterator
from pathlib import Path

import pytest

from sfm.core.errors import SfmError
from sfm.viz import rerun_viewer
from sfm.viz.web_viewer import POLICY, scene_server, viewer_files

FILES = {"index.html": b"<html>", "re_viewer.js": b"js", "re_viewer_bg.wasm": b"wasm", "favicon.ico": b"ico"}


@pytest.fixture
def port(tmp_path: Path) -> Iterator[int]:
    """Of a running server of the scene b"scene"."""
    (tmp_path / "x.rrd").write_bytes(b"scene")
    with scene_server(tmp_path / "x.rrd", FILES) as (server, address):
        number = int(server.server_address[1])
        assert server.server_address[0] == "127.0.0.1"
        assert address == f"http://127.0.0.1:{number}/?url=http://127.0.0.1:{number}/scene.rrd"
        thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.01})
        thread.start()
        yield number
        server.shutdown()
        thread.join()


def reply(port: int, path: str, method: str = "GET", **headers: str) -> tuple[int, bytes, http.client.HTTPMessage]:
    connection = http.client.HTTPConnection("127.0.0.1", port, timeout=10)
    try:
        connection.request(method, path, headers=headers)
        answer = connection.getresponse()
        return answer.status, answer.read(), answer.headers
    finally:
        connection.close()


def test_the_viewer_and_the_scene_are_served(port: int) -> None:
    for path, body, kind in [
        ("/", b"<html>", "text/html; charset=utf-8"),
        ("/?url=http://x", b"<html>", "text/html; charset=utf-8"),
        ("/re_viewer_bg.wasm", b"wasm", "application/wasm"),
        ("/scene.rrd", b"scene", "application/octet-stream"),
    ]:
        status, content, headers = reply(port, path)
        assert (status, content, headers["Content-Type"]) == (200, body, kind)


def test_every_reply_forbids_the_browser_to_ask_another_host(port: int) -> None:
    assert reply(port, "/")[2]["Content-Security-Policy"] == POLICY
    assert "default-src 'self'" in POLICY
    assert "http" not in POLICY
    assert "*" not in POLICY


def test_nothing_else_is_served(port: int) -> None:
    for path in ("/x.rrd", "/../x.rrd", "/etc/passwd", "//", "/sw.js"):
        assert reply(port, path)[0] == (200 if path == "//" else 404)


def test_a_foreign_name_for_this_machine_is_refused(port: int) -> None:
    assert reply(port, "/scene.rrd", Host="evil.example:80")[0] == 403
    assert reply(port, "/scene.rrd", Host=f"localhost:{port}")[0] == 200


def test_head_gives_the_length_without_the_scene(port: int) -> None:
    status, content, headers = reply(port, "/scene.rrd", method="HEAD")
    assert (status, content, headers["Content-Length"]) == (200, b"", "5")


def test_a_program_that_serves_nothing_is_an_error_with_a_remedy() -> None:
    with pytest.raises(SfmError, match="try without --web"):
        viewer_files(["false"])


def test_rerun_hands_out_the_files_of_its_viewer() -> None:
    pytest.importorskip("rerun_cli")
    with rerun_viewer._silent_environment():
        files = viewer_files(rerun_viewer._launcher())
    assert set(files) == set(FILES)
    assert b"re_viewer.js" in files["index.html"]
    assert b"re_viewer_bg.wasm" in files["index.html"]
    assert files["re_viewer_bg.wasm"][:4] == b"\0asm"
