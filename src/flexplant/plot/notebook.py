"""Pictures that a notebook shows with a value, and modes that move."""

from __future__ import annotations

import base64
from collections.abc import Callable
from contextlib import suppress
from io import BytesIO
from typing import Any

import matplotlib.pyplot as plt

from ..errors import FlexplantError
from ..labels import DofSet
from ..loop import ClosedLoop, ErrorBudget
from ..lti import StateSpace
from ..lti.frequency import Frf
from ..modes import Modes
from ..placement import ParetoCurve, SensorMap
from ..plant import StandardPlant
from ..reduction import ReducedModel
from ..simulation import Response
from ..structure import FEModel
from ..updating import UpdateResult
from ._axes import CHANNELS
from .bode_diagrams import bode
from .errors import budget
from .html_page import moving_frame
from .loops import sensitivity
from .placement import pareto_curve, placed, sensor_map
from .run_pictures import response
from .shapes import layout
from .updating import parameters

#: resolution of pictures [dots per inch]
_DPI = 80


def _pairs(value: Frf | StateSpace) -> Any:
    if len(value.inputs) * len(value.outputs) > CHANNELS:
        raise FlexplantError("too many pairs for one picture")
    return bode(value)


#: how each kind of value is drawn
PICTURES: dict[type, Callable[[Any], Any]] = {
    Frf: _pairs,
    StateSpace: _pairs,
    Response: response,
    ClosedLoop: sensitivity,
    ErrorBudget: budget,
    FEModel: lambda model: layout(model.dofs),
    DofSet: layout,
    StandardPlant: placed,
    SensorMap: sensor_map,
    ParetoCurve: pareto_curve,
    UpdateResult: parameters,
}


def picture_of(value: Any) -> str:
    """Return the picture of a value as HTML; empty for a kind that has none.

    Modes turn and move in a separate frame. A value that its plot refuses has no picture: a loop
    without references, for instance, has no |S|.
    """
    if isinstance(value, Modes | ReducedModel):
        return moving_frame(value if isinstance(value, Modes) else value.modes())
    draw = next((draw for kind, draw in PICTURES.items() if isinstance(value, kind)), None)
    with suppress(FlexplantError):
        return _drawn(draw, value) if draw else ""
    return ""


def _drawn(draw: Callable[[Any], Any], value: Any) -> str:
    before = set(plt.get_fignums())
    try:
        draw(value)
        file = BytesIO()
        plt.gcf().savefig(file, format="png", dpi=_DPI)
    finally:
        for number in set(plt.get_fignums()) - before:  # not to be shown again by the notebook
            plt.close(number)
    data = base64.b64encode(file.getvalue()).decode()
    return f'<img alt="{type(value).__name__}" src="data:image/png;base64,{data}"/>'
