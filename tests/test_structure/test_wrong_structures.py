"""Wrong kinds given to structure, reduction and io: our errors, never Python's."""

from functools import cache

import pytest

import flexplant as fx
from flexplant import io
from flexplant.errors import ModelError
from flexplant.structure import FEMatrices, FEModel, PointMass, Spring, beam, chain
from test_wrong_kinds import by_function, not_refused

PLATE = {
    "size": (0.6, 0.6), "thickness": 0.0272, "elements": (4, 4), "density": 2702.0,
    "youngs_modulus": 70e9, "poisson_ratio": 0.35,
}  # fmt: skip
BEAM = {
    "length": 1.0, "elements": 4, "density": 7800.0, "youngs_modulus": 2e11, "area": 1e-4,
    "inertia": 1e-9,
}  # fmt: skip


@cache
def plate():
    return fx.kirchhoff_plate(**PLATE)


@cache
def text():
    return FEMatrices(plate().K, plate().M, dofs=plate().dofs)


@cache
def modes():
    return fx.solve_modes(plate(), count=12)


@cache
def rom():
    return fx.reduce(plate(), fx.reduction.Guyan(["1:z", "5:z", "21:z", "25:z"]))


def of_plate(**options):
    return fx.kirchhoff_plate(**(PLATE | options))


def of_beam(**options):
    return beam(**(BEAM | options))


def model(**options):
    return FEModel(**({"M": plate().M, "K": plate().K, "dofs": plate().dofs} | options))


#: (name, call of one argument, kinds that are allowed there)
CALLS = [
    ("plate size", lambda x: of_plate(size=x), ()),
    ("plate thickness", lambda x: of_plate(thickness=x), ("fraction",)),
    ("plate elements", lambda x: of_plate(elements=x), ()),
    ("plate density", lambda x: of_plate(density=x), ("fraction",)),
    ("plate poisson_ratio", lambda x: of_plate(poisson_ratio=x), ()),
    ("beam length", lambda x: of_beam(length=x), ("fraction",)),
    ("beam elements", lambda x: of_beam(elements=x), ()),
    ("beam inertia", lambda x: of_beam(inertia=x), ("fraction",)),
    ("beam ends", lambda x: of_beam(ends=x), ()),
    ("chain masses", lambda x: chain(masses=x, stiffnesses=[5.0]), ()),
    ("chain stiffnesses", lambda x: chain(masses=[1.0, 2.0], stiffnesses=x), ()),
    ("FEModel M", lambda x: model(M=x), ()),
    ("FEModel K", lambda x: model(K=x), ()),
    ("FEModel D", lambda x: model(D=x), ("none",)),
    ("FEModel dofs", lambda x: model(dofs=x), ("none",)),
    ("with_parts", lambda x: plate().with_parts(x), ()),
    ("PointMass", lambda x: plate().with_parts(PointMass("1:z", x)), ("fraction",)),
    ("PointMass at", lambda x: plate().with_parts(PointMass(x, 1.0)), ()),
    ("Spring to", lambda x: plate().with_parts(Spring("1:z", 1.0, to=x)), ("none",)),
    ("fixed", lambda x: plate().fixed(x), ()),
    ("with_damping", lambda x: plate().with_damping(x), ()),
    ("converted", lambda x: text().converted(x), ("fraction",)),
    ("FEMatrices K", lambda x: FEMatrices(x), ()),
    ("FEMatrices M", lambda x: FEMatrices(plate().K, x), ("none",)),
    ("FEMatrices digits", lambda x: FEMatrices(plate().K, digits=x), ("none",)),
    ("with_dofs", lambda x: text().with_dofs(x), ("text",)),
    ("located_at nodes", lambda x: text().located_at(x, [[0.0, 0, 0]]), ()),
    ("located_at xyz", lambda x: text().located_at([1], x), ()),
    ("without", lambda x: text().without(x), ()),
    ("rotated", lambda x: text().rotated(x), ()),
    ("model massless", lambda x: text().model(massless=x), ()),
    ("model free", lambda x: text().model(free=x), ("bool",)),
    ("check", lambda x: fx.check(x), ()),
    ("ModalDamping", lambda x: fx.ModalDamping(x), ()),
    ("ModalDamping rigid", lambda x: fx.ModalDamping(0.01, rigid=x), ("fraction",)),
    ("Rayleigh", lambda x: fx.structure.Rayleigh(x, 0.0), ("fraction",)),
    ("Rayleigh rigid", lambda x: fx.structure.Rayleigh(1.0, 0.0, rigid=x), ("bool",)),
    ("reduce", lambda x: fx.reduce(x, fx.reduction.Guyan(["1:z"])), ()),
    ("reduce method", lambda x: fx.reduce(plate(), x), ()),
    ("Guyan", lambda x: fx.reduce(plate(), fx.reduction.Guyan(x)), ()),
    ("DesiredDofs", lambda x: fx.reduce(modes(), fx.DesiredDofs(x)), ()),
    ("CraigBampton modes", lambda x: fx.reduction.CraigBampton(["1:z"], x), ()),
    (
        "CraigBampton below",
        lambda x: fx.reduction.CraigBampton(["1:z"], below=x),
        ("none", "fraction"),
    ),
    ("Rubin modes", lambda x: fx.reduction.Rubin(["1:z"], x), ()),
    (
        "Krylov freq",
        lambda x: fx.reduce(plate(), fx.reduction.Krylov(["1:z"], freq=x)),
        ("fraction", "bool"),
    ),
    ("ModalTruncation", lambda x: fx.reduction.ModalTruncation(x), ()),
    ("quality", lambda x: rom().quality(x, band=(10, 100)), ()),
    ("quality band", lambda x: rom().quality(plate(), band=x), ()),
    ("select_dofs", lambda x: fx.select_dofs(x, 5), ()),
    ("select_dofs count", lambda x: fx.select_dofs(modes(), x), ()),
    ("select_dofs candidates", lambda x: fx.select_dofs(modes(), 12, candidates=x), ("none",)),
    ("select_dofs criterion", lambda x: fx.select_dofs(modes(), 12, criterion=x), ("none",)),
    ("DofSet nodes", lambda x: fx.DofSet(x, ["x"], [[0, 0, 0]]), ()),
    ("DofSet xyz", lambda x: fx.DofSet([1], ["x"], x), ("none",)),
    ("where box", lambda x: plate().dofs.where(box=x), ("none",)),
    ("nearest", lambda x: plate().dofs.nearest(x), ()),
    ("dofs.row", lambda x: plate().dofs.row(x), ()),
    ("rank_modes", lambda x: fx.reduction.rank_modes(x, inputs="1:z"), ()),
    *(
        (name, getattr(io, name), ("text",))
        for name in sorted(vars(io))
        if name.startswith("read_") and name != "read_modes"
    ),
    ("read_modes", lambda x: io.read_modes(x, zeta=0.01), ("text",)),
    ("read_model units", lambda x: fx.read_model("a.mtx", units=x), ()),
]  # fmt: skip


GROUPS = by_function(CALLS)


@pytest.mark.parametrize("function", GROUPS)
def test_wrong_kinds_are_refused_with_a_next_step(function):
    wrong = not_refused(GROUPS[function])
    assert not wrong, "\n".join(wrong)


@pytest.mark.parametrize("option", ["thickness", "density", "poisson_ratio"])
def test_a_function_of_too_few_arguments_is_told_what_it_is_asked(option):
    with pytest.raises(
        ModelError, match=rf"{option} is evaluated at the centre \(x, y\).*lambda x, y"
    ):
        of_plate(**{option: lambda x: 0.2})


def test_an_error_inside_a_users_function_is_the_users():
    def thickness(x, y):
        raise TypeError("mine")

    with pytest.raises(TypeError, match="mine"):
        of_plate(thickness=thickness)
