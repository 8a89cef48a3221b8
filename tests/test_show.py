"""What values show in notebooks, certificates in words, and versions."""

from xml.etree import ElementTree as ET

import numpy as np
import pytest

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
    assert repr(observer.certificate).startswith("<Certificate\n  checked ")
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


def test_a_certificate_is_a_table_of_figures_with_limits_and_goes_through_a_file(tmp_path):
    Certificate, Verified = fx.loop.Certificate, fx.loop.Verified
    kept = Verified("norm", 1.0, "a sweep", 1.1)
    broken = Verified("margin", 0.3, "four blocks", 0.5, at_least=True)
    free = Verified("claim", 2.0)
    assert [one.holds for one in (kept, broken, free)] == [True, False, None]
    found = Certificate((kept, free))
    assert found.holds and not (found | Certificate((broken,))).holds
    assert dict(found.extended(Verified("claim", 3.0))) == {"norm": 1.0, "claim": 3.0}
    with pytest.raises(TypeError):
        found | {"claim": 3.0}  # a figure without its route
    with pytest.raises(KeyError, match="margin"):
        found["margin"]
    assert repr(found | Certificate((broken,))).splitlines() == [
        "<Certificate",
        "  checked  figure                   limit        route",
        "  norm          1             at most 1.1      a sweep",
        "  claim         2",
        "  margin      0.3  at least 0.5, not kept  four blocks>",
    ]
    found.save(tmp_path / "certificate.npz")
    again = fx.load(tmp_path / "certificate.npz")
    assert [one.row for one in again.checks] == [one.row for one in found.checks]


def test_every_answer_with_a_certificate_states_routes_and_limits():
    """Filters, H2, H-infinity, servos and joined machines: all limits are kept."""
    plant = fx.testbeds.three_masses()
    observer = fx.design_kalman(plant)
    servo = fx.design_servo(plant, bandwidth=20.0, observer=observer)
    parts = {n: fx.chain(masses=[1.0, 2.0], stiffnesses=[5e5]) for n in ("stage", "frame")}
    machine = fx.joined(parts, fx.joining.Joint("stage/1:x", "frame/1:x"))
    answers = [observer, servo, fx.design_h2(plant), machine.joining]
    for answer in answers:
        found = answer.certificate
        assert isinstance(found, fx.loop.Certificate) and found.holds
        assert any(one.limit is not None and one.route for one in found.checks)
