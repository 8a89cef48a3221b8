"""Gestures: what the mouse does in the pictures: drags an element, takes a machine."""

from __future__ import annotations

from functools import partial
from typing import Any

import numpy as np

from ..synthesis import Notch
from .fields import with_element
from .views import magnitude_db

#: how near a handle or a curve is that the mouse means, beside the picture
_NEAR = 0.06


class Gestures:
    """What is dragged and clicked in the pictures of a page."""

    def __init__(self, page: Any) -> None:
        self.page = page
        #: the element that is dragged
        self.at: int | None = None
        self._height = 0.0

    def connect(self) -> None:
        """Follow the mouse."""
        from bokeh.events import Pan, PanEnd, PanStart, Tap

        figure = self.page.views.figures["magnitude"]
        figure.on_event(PanStart, self.grasp)
        figure.on_event(Pan, self.drag)
        figure.on_event(PanEnd, self.drop)
        for name in ("magnitude", "S"):
            self.page.views.figures[name].on_event(Tap, partial(self.tap, name))

    def _distances(self, x: float, y: float, xs: Any, ys: Any) -> Any:
        """Return distances to points of the magnitude picture, beside its size."""
        fig, span = self.page.views.figures["magnitude"], self.page.views.freq_range
        wide = np.log(span.end / span.start)
        tall = fig.y_range.end - fig.y_range.start
        return np.hypot(np.log(np.asarray(xs) / x) / wide, (np.asarray(ys) - y) / tall)

    def grasp(self, event: Any) -> None:
        """Take the handle that is near, if one is."""
        handles = self.page.views.sources["handles"].data
        self.at = None
        if event.x is None or event.x <= 0.0 or not len(handles["x"]):
            return
        distance = self._distances(event.x, event.y, handles["x"], handles["y"])
        nearest = int(np.argmin(distance))
        if distance[nearest] < _NEAR:
            self.at = int(handles["at"][nearest])
            self._height = event.y

    def drag(self, event: Any) -> None:
        """Move the element that is held: sideways its frequency, upwards the depth of a notch."""
        if self.at is None or event.x is None or not 0.0 < event.x < self.page.bench.top:
            return
        axis = self.page.design.axes[self.page.axis]
        element: Any = axis.elements[self.at].replace(freq=float(f"{event.x:.4g}"))
        if isinstance(element, Notch):  # up and down: its depth
            depth = element.depth * 10.0 ** ((event.y - self._height) / 20.0)
            element = element.replace(depth=float(f"{min(max(depth, 1e-3), 10.0):.3g}"))
        self._height = event.y
        self.page.change_axis(with_element(axis, self.at, element), ("drag", self.at), True)

    def drop(self, event: Any) -> None:
        """Leave the element where it is."""
        if self.at is not None:
            self.drag(event)
        self.at = None
        self.page.soon()

    def tap(self, name: str, event: Any) -> None:
        """Take the machine of a fleet whose curve is clicked."""
        if len(self.page.bench.machines) < 2 or event.x is None or event.x <= 0.0:
            return
        fig = self.page.views.figures[name]
        tall = fig.y_range.end - fig.y_range.start
        distances = []
        for loop in self.page.fleet:
            curve = magnitude_db(loop.L if name == "magnitude" else loop.S)
            distances.append(abs(float(np.interp(event.x, loop.freq, curve)) - event.y) / tall)
        nearest = int(np.argmin(distances))
        if distances[nearest] < _NEAR:
            self.page.machines.value = nearest
