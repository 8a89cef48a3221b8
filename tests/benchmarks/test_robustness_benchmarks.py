"""Designs on the drawing and on the updated model, on random machines: how many loops hold."""

import warnings

import numpy as np
import pytest

import flexplant as fx
from flexplant.structure import FEModel
from stages import L, ports

MACHINES, RATE = 16, 1e4
MODES = tuple(range(4, 13))


def drawing(modulus=70e9):
    return fx.kirchhoff_plate(
        size=(L, L), thickness=0.0272, elements=(8, 8), density=2702,
        youngs_modulus=modulus, poisson_ratio=0.35,
    )  # fmt: skip


def machine(rng, damping):
    """0 to 1 kg anywhere, Young's modulus within 3 %; damping is that of the bare plate."""
    bare = drawing(70e9 * (1 + rng.uniform(-0.03, 0.03))).with_damping(fx.ModalDamping(damping))
    at = bare.dofs.nearest((*rng.uniform(0, L, 2), 0.0), "z")
    row = np.zeros(bare.n_dof)
    row[bare.dofs.index(at)] = 1.0
    kg = rng.uniform(0, 1)
    return FEModel(bare.M + kg * np.outer(row, row), bare.K, bare.D, dofs=bare.dofs), at, kg


def models(truth, at, damping):
    """The drawing in 25 physical DOFs, and updated by nine measured modes."""
    modes = fx.solve_modes(
        drawing(), count=24, damping=fx.ModalDamping(damping), compliance_at=[at]
    )
    spots = [(x, y, 0.0) for y in np.linspace(0, L, 5) for x in np.linspace(0, L, 5)]
    nominal = fx.reduce(modes, fx.DesiredDofs([modes.dofs.nearest(p, "z") for p in spots]))
    true = fx.solve_modes(truth, count=max(MODES))
    freq, zeta = (np.asarray(part)[[m - 1 for m in MODES]] for part in (true.freq, true.zeta))
    omega = 2 * np.pi * freq
    measured = fx.MeasuredModes(omega * (-zeta + 1j * np.sqrt(1 - zeta**2)), modes=MODES)
    unknowns = [fx.AddedMass(at), fx.MatrixParameter("modulus", dK=drawing().K)]
    return nominal, fx.update(nominal, unknowns, [fx.Eigenvalues(measured)]).model


def radius(model, truth, bandwidth):
    """The spectral radius on the machine of the design by the default weights."""
    plant = fx.assemble_plant(model, ports()).discretized(RATE, delay=1)
    errors, weights = fx.reference_errors(plant), fx.stage_weights(plant, bandwidth)
    found = fx.design_hinf(plant.through(errors).weighted(z=weights.z, w=weights.w))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", fx.FlexplantWarning)
        whole = fx.assemble_plant(truth, ports()).discretized(RATE, delay=1)
        return fx.close_loop(whole, errors, found).spectral_radius


@pytest.mark.benchmark
@pytest.mark.parametrize("damping", [0.001, 0.01])
def test_designs_on_random_machines(damping, capsys):
    """At 0.1 % damping the drawing is enough for none of them, the updated model for all."""
    counts = {"drawing": 0, "updated": 0}
    rows = []
    for rng in np.random.default_rng(16).spawn(MACHINES):
        truth, at, kg = machine(rng, damping)
        found = [radius(m, truth, 100.0) for m in models(truth, at, damping)]
        for name, value in zip(counts, found, strict=True):
            counts[name] += value < 1
        rows.append(f"{kg:8.3f} kg at {at:8s} {found[0]:12.6f} {found[1]:12.6f}")
    with capsys.disabled():
        print(f"\n100 Hz at {damping:.1%} damping: radius on the machine, drawing and updated")
        print("\n".join(rows))
        print(f"stable on {counts['drawing']} and {counts['updated']} of {MACHINES}")
    assert counts["updated"] >= 14
    if damping == 0.001:
        assert counts["drawing"] <= 2
