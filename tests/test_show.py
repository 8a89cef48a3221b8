"""What values show in notebooks, certificates in words, and versions."""

from xml.etree import ElementTree as ET

import numpy as np

import flexplant as fx
from flexplant.certificates import one_line
from flexplant.rooms import versions
from flexplant.store import as_html
from stages import RATE, ports, reduced


def test_entries_become_rows_and_tables_keep_their_columns():
    table = "     x    y\n  a  1    2"
    shown = as_html(f"<Loop 'a<b': 2>\n  stable: yes, 0.9\n  mass at 3:z = 0.5 kg\n{table}")
    tree = ET.fromstring(shown)
    assert tree.find("div/b").text == "Loop"
    assert [[c.text for c in row] for row in tree.iter("tr")] == [
        ["stable", "yes, 0.9"],
        ["mass at 3:z", "0.5 kg"],
    ]
    assert tree.find("pre").text == table
    hostile = as_html("<script>alert('x')</script>\n  <img src=x>: </td>&")
    assert "<script" not in hostile and "<img" not in hostile
    ET.fromstring(hostile)


def test_certificates_in_words():
    found = {"norm": 1.234567, "spectral radius": 0.99998, "largest real part": -0.62661}
    assert (
        one_line(found) == "norm 1.235, spectral radius 0.999980, largest real part -0.6266 rad/s"
    )
    assert one_line({"spectral_radius": 1.0, "left_out": None}) == "spectral radius 1.0000"
    plant = fx.assemble_plant(reduced(), ports()).discretized(RATE, delay=1)
    observer = fx.design_kalman(plant)
    assert repr(observer.certificate).startswith("<KalmanCertificate: spectral radius 0.99")
    assert "stability" not in repr(fx.design_servo(plant, bandwidth=40.0, observer=observer))


def test_a_controller_shows_its_lower_bound_beside_gamma():
    g = fx.StateSpace([[-1.0]], [[1.0]], [[1.0]], 0)
    plant = fx.plant.mixed_sensitivity(g, S=fx.lti.low_pass_filter(1.0) * 2.0, KS=0.1)
    found = fx.design_hinf(plant)
    assert f"gamma {found.gamma:.4g} (lower bound {found.lower:.4g})" in repr(found)
    assert 0 < found.lower <= found.gamma
    assert "largest real part -" in repr(found) and "stability" not in repr(found)


def test_versions_of_all_that_results_depend_on(capsys):
    fx.show_versions()
    lines = dict(line.split(maxsplit=1) for line in capsys.readouterr().out.splitlines())
    assert lines["numpy"] == np.__version__
    assert lines["flexplant"] == fx.__version__
    assert {"scipy", "control", "cvxpy", "clarabel", "matplotlib", "python"} <= set(lines)
    found = versions()
    assert any(name.startswith("BLAS of") and "thread" in text for name, text in found.items())
