"""The server of the page, for this computer only; plants and designs from files."""

from __future__ import annotations

import asyncio
import socket
import sys
import threading
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import Any, Self

from ..arrays import FloatArray, instance, whole
from ..errors import FlexplantError, LabelError, ModelError
from ..io import read_frf_csv, read_frf_mat, read_frf_npz, read_frf_uff, read_mat
from ..lti.frequency import Frf
from ..lti.statespace import StateSpace, System
from ..parallel import in_notebook
from ..plant import StandardPlant
from ..simulation.motion import SetPointProfile
from ..store import load
from ..synthesis import LoopDesign
from .bench import Bench
from .page import Page
from .verdict import LoopLimits

HOST = "127.0.0.1"
#: lifetime of a session after its tab is closed, and period of the check [ms]
_LIFETIME, _CHECKED = 4000, 1000
#: largest duration of a start or an end [s]
_TIMEOUT = 30.0


def free_port() -> int:
    """Return a free port."""
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
        """Wait until the server ends or Ctrl-C is pressed."""
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


class WorkbenchServer(Bench):
    """Server of the page, from `open_page`; in a notebook it displays the page.

    Parameters
    ----------
    machines : mapping {name: plant}
        Plants by name; the loop is shaped on the first of them.
    design : LoopDesign
        First design. Later, `design` is the one that was changed last in any tab.
    model, channel, move, limits, source : as for `open_page`

    Examples
    --------
    >>> import flexplant as fx
    >>> mass = fx.lti.discretized(fx.lti.tf([1.0], [1.0, 0.0, 0.0]), 2e3, delay=1)
    >>> fx.workbench.open_page(mass, open_browser=False).top < 1e3  # frequencies of sliders [Hz]
    True
    """

    _server: Served | None = None

    def panel(self) -> Any:
        """Return a new page as a Panel object, to be placed in another Panel application."""
        return Page(self).layout

    def servable(self) -> Any:
        """Return the page for ``panel serve``."""
        return self.panel().servable("flexplant workbench")

    def _repr_mimebundle_(self, include: Any = None, exclude: Any = None) -> Any:
        """Show the page in the cell of a notebook."""
        import panel as pn

        if in_notebook():
            pn.extension()  # a notebook shows it once
        return self.panel()._repr_mimebundle_(include, exclude)

    @property
    def url(self) -> str:
        """Address of the page while it is served."""
        return "" if self._server is None else f"http://127.0.0.1:{self._server.port}/"

    def serve(self, port: int = 0, *, open_browser: bool = False, block: bool = False) -> Self:
        """Serve the page on this computer only.

        Parameters
        ----------
        port : int
            Port of the server; 0 takes a free one.
        open_browser : bool
            Whether to open the page in the browser.
        block : bool
            Whether to wait until Ctrl-C ends the server.
        """
        if self._server is not None:
            raise FlexplantError(f"the page is served already, at {self.url}. close() it first.")
        self._server = Served(self.panel, port)
        if open_browser:
            import webbrowser

            webbrowser.open(self.url)
        if block:
            self.wait()
        return self

    def wait(self) -> None:
        """Wait until Ctrl-C, or `close` in another thread, ends the server."""
        if self._server is not None:
            try:
                self._server.wait()
            finally:
                self.close()

    def close(self) -> None:
        """End the server and all its sessions."""
        if self._server is not None:
            self._server.close()
            self._server = None


def open_page(
    plant: Any,
    *,
    design: LoopDesign | None = None,
    model: StandardPlant | System | None = None,
    before: System | FloatArray | None = None,
    after: System | FloatArray | None = None,
    rate: float | None = None,
    delay: float | None = None,
    hold: bool | None = None,
    rigid: int | None = None,
    unstable: int | None = None,
    references: Mapping[str, str] | None = None,
    channel: str | None = None,
    move: SetPointProfile | None = None,
    limits: LoopLimits | None = None,
    source: str = "",
    port: int = 0,
    open_browser: bool = True,
    block: bool | None = None,
) -> WorkbenchServer:
    """Open a page in the browser on which loops are shaped by hand, axis by axis.

    The page is served on this computer only. In a notebook the returned object displays the page;
    its attribute `design` is the present design.

    Parameters
    ----------
    plant : Frf, StandardPlant, StateSpace, or a list or mapping of them
        Measured or modelled plant. If several are given (a fleet), the loop is shaped on the first
        and judged on all of them.
    design : LoopDesign, optional
        Design to continue. By default each axis begins with a PID controller and a low-pass filter
        well below its resonances.
    model : StandardPlant or StateSpace, optional
        Model of a measured plant. Its response is drawn next to the measurement. The predicted
        servo error and the effect of truncated modes are computed with it.
    before, after, rate, delay, hold, rigid, unstable, references
        Arguments of `design_loops`. By default they follow from the plant or model and the axes
        that its actuators drive.
    channel : str, optional
        Channel of z whose rms is predicted; by default the first error of the plant.
    move : SetPointProfile, optional
        Set-point profile whose error is drawn; by default a unit step.
    limits : LoopLimits, optional
        Limits that the page draws and checks.
    source : str
        Line of Python that makes the plant. The script that the page writes contains it.
    port : int
        Port of the server; 0 takes a free one.
    open_browser : bool
        Whether to serve the page and open it. With False the page is not served until you call
        `serve` of the returned object.
    block : bool, optional
        Whether to wait until Ctrl-C. By default it waits only if Python runs a script.

    Returns
    -------
    WorkbenchServer

    Raises
    ------
    ModelError, LabelError, ShapeError, AssumptionError
        As for `design_loops`; ModelError also when an option has a wrong type.
    FlexplantError
        When Panel is missing, or the port is taken.

    Examples
    --------
    >>> import flexplant as fx
    >>> mass = fx.lti.discretized(fx.lti.tf([1.0], [1.0, 0.0, 0.0]), 2e3, delay=1)
    >>> bench = fx.workbench.open_page(mass, open_browser=False)
    >>> bench.design.loops(mass).report.is_stable
    True
    """
    instance(limits, LoopLimits | None, "limits", "Pass LoopLimits(peak=2.0).")
    instance(move, SetPointProfile | None, "move", "Pass setpoint(...).")
    instance(design, LoopDesign | None, "design", "Pass LoopDesign.on(plant).", LabelError)
    options = {
        "model": model, "before": before, "after": after, "rate": rate,
        "delay": delay, "hold": hold, "rigid": rigid, "unstable": unstable,
        "references": references, "channel": channel, "move": move, "limits": limits,
        "source": source,
    }  # fmt: skip
    bench = WorkbenchServer.of(plant, design, options)
    if open_browser and not in_notebook():
        waits = not sys.flags.interactive and not hasattr(sys, "ps1")
        bench.serve(port, open_browser=True, block=waits if block is None else block)
    return bench


def open_file(
    path: str | Path, *, quantity: str | None = None, scale: float | None = None
) -> tuple[Any, LoopDesign | None, str]:
    """Return the plant of a file, or the design, and the line of Python that reads it.

    Parameters
    ----------
    path : str or Path
        Universal, CSV, MATLAB or NumPy file with a frequency response, or a file that was written
        by `.save` of a plant, a response or a LoopDesign.
    quantity : {"displacement", "velocity", "acceleration"}, optional
        Wanted quantity of the outputs of a measurement; see `flexplant.io.read_frf_uff`.
    scale : float, optional
        Factor that converts the numbers of a universal file to SI units, if the file does not state
        its units clearly.

    Raises
    ------
    FlexplantError
        When the file contains neither a plant, nor a response, nor a design.
    ModelError
        When `quantity` or `scale` is given for something else than a measurement.
    FileNotFoundError
        When the file does not exist.

    Examples
    --------
    >>> import flexplant as fx, os, tempfile
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     path = os.path.join(folder, "mass.npz")
    ...     fx.lti.tf([1.0], [1.0, 0.0, 0.0]).save(path)
    ...     plant, design, line = fx.workbench.open_file(path)
    >>> plant.n_states, design
    (2, None)
    """
    file = Path(path)
    if not file.exists():
        raise FileNotFoundError(f"file {str(file)!r} does not exist.")
    options: dict[str, Any] = {"quantity": quantity, "scale": scale}
    given = {name: value for name, value in options.items() if value is not None}
    said = "".join(f", {name}={value!r}" for name, value in given.items())
    reader = partial(read_frf_uff, **given)
    universal: dict[str, Callable[[Path], Any]] = {"io.read_frf_uff": reader}
    readers: dict[str, dict[str, Callable[[Path], Any]]] = {
        ".uff": universal, ".unv": universal, ".uf": universal,
        ".csv": {"io.read_frf_csv": read_frf_csv},
        ".mat": {"io.read_mat": read_mat, "io.read_frf_mat": read_frf_mat},
        ".npz": {"load": load, "io.read_frf_npz": read_frf_npz},
    }  # fmt: skip
    if file.suffix.lower() not in readers:
        raise FlexplantError(
            f"{str(file)!r} is of no kind that the workbench opens: {', '.join(readers)}."
        )
    problems = []
    for name, read in readers[file.suffix.lower()].items():
        try:
            value = read(file)
            line = f"plant = fx.{name}({str(file)!r}{said if read is reader else ''})"
            break
        except FlexplantError as problem:
            problems.append(problem)
    else:
        raise problems[0]
    if isinstance(value, LoopDesign):
        return None, value, ""
    if not isinstance(value, Frf | StandardPlant | StateSpace):
        raise ModelError(
            f"{str(file)!r} holds a {type(value).__name__}: the workbench opens a measured Frf, a "
            "StandardPlant, a StateSpace or a LoopDesign."
        )
    if given and read is not reader:
        if scale is not None or quantity is None or not isinstance(value, Frf):
            raise ModelError(
                f"{str(file)!r} is not a universal file: it takes no scale, and a plant takes no "
                "quantity. Leave them out."
            )
        value, line = value.converted(quantity), f"{line}.converted({quantity!r})"
    return value, None, line
