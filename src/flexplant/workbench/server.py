"""Served: the page on 127.0.0.1, in a thread of its own, for this machine's browser only."""

from __future__ import annotations

import asyncio
import socket
import threading
from collections.abc import Callable
from typing import Any

from ..checks import whole
from ..errors import FlexplantError

HOST = "127.0.0.1"
#: of a session whose tab was closed, and how often that is checked [ms]
_LIFETIME, _CHECKED = 4000, 1000
#: how long a start or an end may take [s]
_TIMEOUT = 30.0


def free_port() -> int:
    """Return a port that nothing uses."""
    with socket.socket() as probe:
        probe.bind((HOST, 0))
        return int(probe.getsockname()[1])


class Served:
    """A server that makes a page for each tab."""

    def __init__(self, make: Callable[[], Any], port: int = 0) -> None:
        self.port = whole(port, "port", minimum=0, maximum=65535) or free_port()
        self.error: BaseException | None = None
        self._make = make
        self._server: Any = None
        self._loop: Any = None
        self._ready, self._over = threading.Event(), threading.Event()
        self._thread = threading.Thread(target=self._run, name="workbench", daemon=True)
        self._thread.start()
        self._ready.wait(_TIMEOUT)
        if self.error is not None or self._server is None:
            raise FlexplantError(
                f"the page cannot be served on port {self.port} ({self.error}). Pass port=0 for a "
                "free one."
            )

    def _run(self) -> None:
        """Serve until the loop is stopped; in the thread."""
        try:
            asyncio.set_event_loop(asyncio.new_event_loop())
            from panel.io.server import get_server
            from tornado.ioloop import IOLoop

            self._loop = IOLoop.current()
            origins = [f"{name}:{self.port}" for name in (HOST, "localhost")]
            self._server = get_server(
                {"/": self._make}, port=self.port, address=HOST, websocket_origin=origins,
                loop=self._loop, title="flexplant workbench", show=False, start=False,
                unused_session_lifetime_milliseconds=_LIFETIME,
                check_unused_sessions_milliseconds=_CHECKED,
            )  # fmt: skip
        except (Exception, SystemExit) as error:
            self.error = error
            self._ready.set()
            return
        self._server.start()
        self._loop.add_callback(self._ready.set)
        self._loop.start()
        self._server.stop()
        self._over.set()

    @property
    def sessions(self) -> int:
        """The number of open tabs."""
        return len(self._server.get_sessions())

    def wait(self) -> None:
        """Return when the server ended, or at Ctrl-C."""
        try:
            while not self._over.wait(0.2):
                pass
        except KeyboardInterrupt:
            return

    def close(self) -> None:
        """End all sessions and the server."""
        if self._over.is_set() or self._loop is None:
            return

        def end() -> None:
            for session in self._server.get_sessions():
                session.destroy()
            self._loop.stop()

        self._loop.add_callback(end)
        self._over.wait(_TIMEOUT)
