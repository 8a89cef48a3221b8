"""Mistakes of a first hour: the message says which one it was."""

import ast
import operator
import pickle
import re
from pathlib import Path

import numpy as np
import pytest
import scipy.sparse as sp

import flexplant as fx
from flexplant import errors
from flexplant.errors import (
    CertificateError,
    FlexplantWarning,
    LabelError,
    ModelError,
    ShapeError,
    SolverError,
    attempted,
)
from flexplant.rooms import OURS
from flexplant.structure import zero_energy_motions


def test_records_with_time_as_first_axis():
    rng = np.random.default_rng(0)
    u, y = rng.normal(size=(800, 2)), rng.normal(size=(800, 3))
    with pytest.raises(ShapeError, match=r"800 channels of 2 samples each: .* Pass inputs\.T"):
        fx.estimate_frf(u, y, 1e3)
    with pytest.raises(ShapeError, match=r"800 channels of 3 .* Pass np\.swapaxes\(outputs, 1, 2"):
        fx.estimate_frf(u.T[None], y[None], 1e3)
    assert fx.estimate_frf(u.T, y.T, 1e3).data.shape[:2] == (3, 2)


def test_mass_and_stiffness_swapped():
    """Of a free structure, and of one that is held, where both are definite."""
    free = fx.beam(length=1, elements=3, density=1, youngs_modulus=1e9, area=1, inertia=1)
    with pytest.raises(ModelError, match=r"swapped\. The order is FEModel\(M, K, D\)"):
        fx.FEModel(free.K, free.M, dofs=free.dofs)
    held = fx.chain(masses=[1.0, 2.0], stiffnesses=[1e6], ground=[1e6, 0.0])
    with pytest.raises(ModelError, match=r"swapped: no sqrt.* M gives 1 of its DOFs no inertia"):
        fx.FEModel(held.K, held.M, dofs=held.dofs)
    alone = held.fixed(["2:x"])  # of one DOF nobody can be sure
    with pytest.warns(FlexplantWarning, match=r"swapped \(the order is FEModel\(M, K, D\)\)"):
        fx.FEModel(alone.K, alone.M, dofs=alone.dofs)
    with pytest.raises(ModelError, match="no inertia, or a negative one"):  # not that mistake
        fx.FEModel(np.diag([1.0, -1.0]), np.eye(2), dofs=held.dofs)


def test_a_gain_of_zero_written_as_a_number():
    g = fx.StateSpace([[-1.0]], [[1.0, 2.0]], [[1.0], [3.0], [4.0]], 0)
    assert g.D.tolist() == [[0.0, 0.0]] * 3
    with pytest.raises(ShapeError, match=r"from 2 inputs to 3 outputs, .* \(3, 2\); got"):
        g.replace(D=1.0)
    with pytest.raises(ShapeError, match="B must be a matrix"):
        fx.StateSpace([[-1.0]], [1.0], [[1.0]], 0)


def test_channels_by_number():
    g = fx.StateSpace([[-1.0]], [[1.0, 2.0]], [[1.0], [3.0]], 0)
    assert g[0, 1].inputs == ("u2",) and g[0, 1].outputs == ("y1",)
    with pytest.raises(
        LabelError, match=r"input number 2 does not exist: the system has 2 \(u1, u2\)"
    ):
        g[0, 2]
    with pytest.raises(LabelError, match=r"by name, number or slice, got 0\.0"):
        g[0.0, 1]
    with pytest.raises(LabelError, match="a channel is a pair"):
        g[0]


def test_names_of_matlab_and_python_control_lead_to_ours():
    with pytest.raises(AttributeError, match=r"call so is flexplant\.lti\.discretized"):
        _ = fx.c2d
    for name, ours in OURS.items():
        assert not hasattr(fx, name)
        for one in re.findall(r"[\w.]+\w", re.sub(r"\bor\b|\bthen\b", "", ours)):
            item = fx
            for part in one.split("."):
                item = getattr(item, part)
            assert callable(item), "a function or a class, never a module"
        with pytest.raises(AttributeError) as refused:
            getattr(fx, name)
        for one in re.findall(r"flexplant\.([\w.]+\w)", str(refused.value)):
            assert callable(operator.attrgetter(one)(fx)), f"fx.{name} is answered with {one}"


def test_one_over_one_plus_l():
    """S and its margins as python-control writes them, of a loop gain with negative feedback."""
    L = fx.lti.tf([25.0], [1.0, 2.0, 0.0])
    S = 1 / (1 + L)
    s = 3.0j
    assert S(s) == pytest.approx(1 / (1 + L(s)), rel=1e-12)
    assert (1 - S)(s) == pytest.approx(L(s) / (1 + L(s)), rel=1e-12)
    peak = fx.peak_gain(S)[0]
    assert fx.modulus_margin(L) == pytest.approx(1 / peak, rel=1e-6)
    (found,) = fx.loop.report_loops(L).loops
    assert found.phase_margin == pytest.approx(22.6, abs=0.1)  # 2 atan(1 / 5) of zeta = 0.2
    with pytest.raises(ModelError, match="its D is not invertible"):
        1 / L
    with pytest.raises(ModelError, match="as many outputs as inputs, got 1 and 2"):
        fx.modulus_margin(fx.StateSpace([[-1.0]], [[1.0, 2.0]], [[1.0]], 0))
    with pytest.raises(ModelError, match="need a ClosedLoop, "):
        fx.modulus_margin("L")


def test_what_is_tried_and_dropped_is_in_the_log(caplog):
    """Silent for whoever does not want it; other errors than the expected pass."""
    with caplog.at_level("INFO", logger="flexplant"):
        with attempted("a quick factor", SolverError):
            raise SolverError("a pivot is zero")
        with pytest.raises(ModelError), attempted("a quick factor", SolverError):
            raise ModelError("M is indefinite")
    assert caplog.messages == ["a quick factor failed and is dropped: a pivot is zero"]


def test_a_failed_certificate_says_what_to_report():
    error = CertificateError("the norm is 2, claimed was 1")
    assert str(error) == "the norm is 2, claimed was 1"
    assert "flexplant.show_versions()" in error.__notes__[0]
    assert pickle.loads(pickle.dumps(error)).args == error.args


#: where an exception is the answer itself (no solution at this level, no choice of this size, a
#: candidate of no use) and nothing is dropped that a reader of a log would want to know
ANSWERS = {
    "hand_design.py", "hinf_riccati.py", "lower_bound.py", "loops.py",
    "search.py", "family.py", "wrapping.py", "searching.py",
    "twins.py",
}  # fmt: skip


@pytest.mark.slow
def test_nothing_is_dropped_without_a_word():
    """An error of ours that is caught and followed by None, continue or pass goes into the log."""
    ours = {n for n, item in vars(errors).items() if isinstance(item, type)}
    silent = []
    for path in Path(fx.__file__).parent.rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if not isinstance(node, ast.ExceptHandler) or len(node.body) != 1 or node.type is None:
                continue
            kinds = {one.id for one in ast.walk(node.type) if isinstance(one, ast.Name)}
            (does,) = node.body
            empty = isinstance(does, ast.Pass | ast.Continue | ast.Break) or (
                isinstance(does, ast.Return)
                and (does.value is None or getattr(does.value, "value", 1) is None)
            )
            if kinds & ours and empty and path.name not in ANSWERS:
                silent.append(f"{path.name}:{node.lineno}")
    assert not silent


def test_a_check_that_fails_itself_is_in_the_log(caplog, monkeypatch):
    """What would have warned of few digits of K is no reason to refuse the model."""

    def failing(*_, **__):
        raise SolverError("no convergence")

    monkeypatch.setattr(zero_energy_motions, "lowest_modes", failing)
    one = sp.csc_array(np.eye(2))
    with caplog.at_level("INFO", logger="flexplant"):
        assert zero_energy_motions.endangered(one, one, 6) is None
    said = "the check of the digits of K by its lowest modes failed and is dropped: no convergence"
    assert caplog.messages == [said]
