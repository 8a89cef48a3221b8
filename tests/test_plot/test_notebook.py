"""What Jupyter shows of a value: its words always, a picture of the kinds that have one."""

import base64
import html
import re
from io import BytesIO
from xml.etree import ElementTree as ET

import matplotlib.pyplot as plt
import numpy as np
import pytest
from PIL import Image

import flexplant as fx
from flexplant.plot.notebook import PICTURES, picture_of

pytestmark = pytest.mark.slow


def values():
    """One value of each kind that has a picture, where it is cheap."""
    plant = fx.testbeds.three_masses()
    observer = fx.design_kalman(plant)
    servo = fx.design_servo(plant, bandwidth=20.0, observer=observer)
    loop = fx.close_loop(plant, observer, servo)
    move = fx.setpoint(1e-3, velocity=0.1, acceleration=10.0)
    g = plant.system["y1", "u1"]
    plate = fx.kirchhoff_plate(
        size=(1.0, 1.0), thickness=0.01, elements=(3, 3), density=2700,
        youngs_modulus=7e10, poisson_ratio=0.3,
    )  # fmt: skip
    return [
        g,
        fx.frequency_response(g, np.geomspace(1.0, 200.0, 50)),
        loop,
        loop.budget("die:error"),
        fx.simulate(loop, reference=move, duration=0.1, rng=1),
        plate,
        plate.dofs,
    ]


def test_pictures_are_drawn_and_closed():
    for value in values():
        assert type(value) in PICTURES
        shown = value._repr_mimebundle_()
        assert shown["text/plain"] == repr(value)
        assert shown["text/html"].startswith(value._repr_html_())
        ET.fromstring(f"<div>{shown['text/html']}</div>")
        (data,) = re.findall(r'src="data:image/png;base64,([^"]+)"', shown["text/html"])
        pixels = np.asarray(Image.open(BytesIO(base64.b64decode(data))).convert("L"), float)
        assert pixels.std() > 5.0, f"the picture of a {type(value).__name__} is blank"
        assert not plt.get_fignums()


def test_modes_turn_and_move_in_a_frame_without_the_net():
    plate = values()[-2]
    shown = picture_of(fx.solve_modes(plate, count=6))
    page = html.unescape(re.search(r'srcdoc="([^"]*)"', shown)[1])
    assert "<canvas" in page and "requestAnimationFrame" in page
    assert not re.search(r"(?:src|href)=.https?:", page)


def test_values_without_a_picture_have_their_words():
    chain = fx.chain(masses=[1.0, 2.0], stiffnesses=[5.0])
    for value in (fx.AddedMass("1:x"), fx.ModalDamping(0.01), fx.Notch(50.0)):
        assert picture_of(value) == ""
        assert value._repr_mimebundle_()["text/html"] == value._repr_html_()
    many = fx.StateSpace([], [], [], np.ones((4, 4)))
    assert picture_of(many) == "", "16 pairs are no picture"
    assert "FEModel" in chain._repr_mimebundle_()["text/html"]
