"""Channels that do not respond, known by the construction of the machine, not by rounding."""

import re
import warnings

import numpy as np
import pytest
import scipy.linalg as la
import scipy.sparse as sp

from flexplant import Actuator, DofSet, FEModel, ModalDamping, Ports, Sensor, frequency_response
from flexplant.modes import solve_modes
from flexplant.reduction import (
    CraigBampton,
    DesiredDofs,
    Guyan,
    Irs,
    Krylov,
    MacNeal,
    ModalBalanced,
    ModalTruncation,
    Rubin,
    Serep,
    reduce,
    select_dofs,
)

N = 7  # masses
LOW = ModalDamping(0.01)
BAND = (5.0, 60.0)


def machine(rng, alike, angle):
    """Three rows of free masses that move along y, z and ry, each row apart from the others.

    Rows y and z are equal when `alike`, as of a symmetric section; ry has another unit. The rows
    are turned in y and z by `angle`; returned with them are the places that move in one row only.
    """
    rows = [(rng.uniform(0.5, 2.0, N), rng.uniform(2e4, 2e5, N - 1)) for _ in range(3)]
    rows[1] = rows[0] if alike else rows[1]
    rows[2] = (1e-6 * rows[2][0], 1e-6 * rows[2][1])  # kg m^2, N m/rad: a millimetre wide
    M = np.diag(np.concatenate([mass for mass, _ in rows]))
    links = np.diff(np.eye(N), axis=0)
    K = la.block_diag(*[links.T @ (k[:, None] * links) for _, k in rows])
    K[2 * N :, 2 * N :] += 1e-3 * np.eye(N)  # turning is held: it is no rigid-body motion of a row
    c, s = np.cos(angle), np.sin(angle)
    turn = la.block_diag(np.kron([[c, -s], [s, c]], np.eye(N)), np.eye(N))
    xyz = np.zeros((3 * N, 3))
    xyz[:, 0] = np.tile(np.arange(N), 3)
    dofs = DofSet(np.tile(np.arange(1, N + 1), 3), np.repeat(["y", "z", "ry"], N), xyz)
    M, K = (sp.csc_array(turn @ matrix @ turn.T) for matrix in (M, K))
    model = FEModel(M, 0.5 * (K + K.T), dofs=dofs)
    places = {"y": {f"{N}:y": c, f"{N}:z": s}, "z": {f"{N}:y": -s, f"{N}:z": c}, "ry": f"{N}:ry"}
    return model, {"1": {"1:y": c, "1:z": s}} | places


KEPT = [f"{n}:{d}" for n in (1, 4, N) for d in ("y", "z", "ry")]
EVERY = {
    "DesiredDofs": lambda nine: DesiredDofs(nine, damping=LOW),
    "ModalTruncation": lambda _: ModalTruncation(9),
    "ModalBalanced": lambda _: ModalBalanced(9, KEPT[:3], damping=LOW),
    "Guyan": lambda _: Guyan(KEPT),
    "Irs": lambda _: Irs(KEPT),
    "Serep": lambda nine: Serep(nine),
    "CraigBampton": lambda _: CraigBampton(KEPT, 2),
    "Rubin": lambda _: Rubin(KEPT, 9),
    "MacNeal": lambda _: MacNeal(KEPT, 9),
    "Krylov": lambda _: Krylov(KEPT[:3], 20.0),
}


@pytest.mark.parametrize("seed, method", list(enumerate(EVERY)), ids=EVERY)
def test_no_silent_channel_is_the_worst(method, seed):
    """Outputs that the input cannot move change neither the worst channel nor its error."""
    model, places = machine(
        np.random.default_rng(seed), alike=seed % 2, angle=0.7 * (seed // 2 % 2)
    )
    nine = select_dofs(solve_modes(model, count=9), 9, candidates=model.dofs.labels).labels
    reduced = reduce(model, EVERY[method](nine))
    of = {"band": BAND, "inputs": [places["1"]]}
    alone = reduced.quality(model, **of, outputs=[places["y"]])
    both = reduced.quality(model, **of, outputs=[places["z"], places["y"], places["ry"]])
    assert both.silent[:, 0].tolist() == [True, False, True]
    assert both.frf_error[1, 0] == pytest.approx(alone.frf_error[0, 0], rel=0.05, abs=1e-9)
    assert f"% of the peak ({both.inputs[0]} -> {alone.outputs[0]})" in repr(both)
    assert np.nanmax(both.antiresonance_error) < 2.5
    assert both.static_error.max() <= max(2.0 * alone.static_error.max(), 1e-6)


def test_a_reduced_model_that_answers_where_the_full_one_is_silent_is_said():
    """A model of the machine turned by another angle couples what the machine does not."""
    model, places = machine(np.random.default_rng(3), alike=False, angle=0.7)
    wrong, _ = machine(np.random.default_rng(3), alike=False, angle=0.6)
    found = reduce(wrong, ModalTruncation(21)).quality(
        model, band=BAND, inputs=[places["1"]], outputs=[places["z"], places["y"]]
    )
    assert found.silent[:, 0].tolist() == [True, False]
    assert found.frf_error[0, 0] > 0.05
    assert "where the full model is silent" in repr(found)


@pytest.mark.parametrize("seed", range(4))
def test_the_direct_check_does_not_divide_by_the_rounding_of_silent_channels(seed):
    """Responses of all channels, or of silent ones only, are as good as those that respond."""
    turned = 0.7 * (seed // 2)
    model, places = machine(np.random.default_rng(seed), alike=seed % 2, angle=turned)
    reduced = reduce(model, ModalTruncation(12))
    for outputs in ("zy", "z"):
        found = reduced.quality(
            model, band=BAND, inputs=[places["1"]], outputs=[places[one] for one in outputs]
        )
        gaps = re.search(r"differ by (\S+) of the peak, (\S+) of the", repr(found)).groups()
        assert float(gaps[0]) < 1e-6 and float(gaps[1]) < 1e-2
        assert np.isnan(found.resonance_error[0, 0])
    ports = Ports(
        u=[Actuator("f", at=places["1"])],
        y=[Sensor("still", at=places["z"], quantity="velocity"), Sensor("turn", at=places["ry"])],
    )
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        found = frequency_response(model, ports, np.linspace(*BAND, 40), damping=LOW)
    assert found.error.max() < 1e-6
