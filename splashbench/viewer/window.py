"""The window of two halves: one page with two frames, each of which is a viser client of its own."""

from __future__ import annotations

import html
import re
from collections.abc import Sequence
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from threading import Thread
from typing import Any

from splashbench.viewer.server import PortTaken

#: Pixels of the panel that is docked in the left half.
PANEL_WIDTH = 320
_PAGE = """<!doctype html>
<html lang="en"><head><meta charset="utf-8"><title>splashbench view</title>
<link rel="icon" href="data:image/svg+xml,%3Csvg xmlns=%27http://www.w3.org/2000/svg%27/%3E"><style>
html, body { margin: 0; height: 100%; font-family: sans-serif; }
/* The panel is docked in the left frame: the pictures beside it are equally wide. */
body { display: grid; grid-template: auto 1fr / calc(50% + PANELpx) calc(50% - PANELpx); }
h1:first-of-type { padding-left: calc(.25em + 2 * PANELpx); }
h1 { margin: 0; padding: .25em; font-size: 1rem; text-align: center; overflow: hidden; white-space: nowrap; }
iframe { border: 0; width: 100%; height: 100%; }
iframe + iframe, h1 + h1 { border-left: 2px solid #999; box-sizing: border-box; }
</style></head><body>
HEADINGS
FRAMES
<script>
for (const frame of document.querySelectorAll("iframe"))
  frame.src = `http://${location.hostname}:${frame.dataset.port}/${location.search}`;
</script></body></html>
"""


class WindowServer:
    """Serves that page on `host` and `port`. ports, names: of the two halves."""

    def __init__(self, host: str, port: int, ports: Sequence[int], names: Sequence[str]) -> None:
        headings = "\n".join(f"<h1>{html.escape(name)}</h1>" for name in names)
        frames = "\n".join(
            f'<iframe data-port="{int(each)}" title="{html.escape(name)}"></iframe>' for each, name in zip(ports, names)
        )
        parts = {"PANEL": str(PANEL_WIDTH // 2), "HEADINGS": headings, "FRAMES": frames}
        # In one pass: a name may hold such a word.
        content = re.sub("|".join(parts), lambda found: parts[found[0]], _PAGE).encode()

        class Exchange(BaseHTTPRequestHandler):
            """Answers with the page."""

            def do_GET(self) -> None:
                found = self.path.partition("?")[0] == "/"
                self.send_response(200 if found else 404)
                self.send_header("Content-Type", "text/html; charset=utf-8")
                self.send_header("Content-Length", str(len(content) if found else 0))
                self.end_headers()
                if found:
                    self.wfile.write(content)

            def log_message(self, *_: Any) -> None:
                """Nothing: standard error is the user's."""

        class Server(ThreadingHTTPServer):
            daemon_threads = True
            address_family = _family(host)

        self.port = port
        try:
            self._server = Server((host, port), Exchange)
        except OSError as error:
            raise PortTaken(port) from error
        Thread(target=self._server.serve_forever, name="viewer window", daemon=True).start()

    def stop(self) -> None:
        """End."""
        self._server.shutdown()
        self._server.server_close()


def _family(host: str) -> Any:
    import socket

    return socket.getaddrinfo(host, None, type=socket.SOCK_STREAM)[0][0]
