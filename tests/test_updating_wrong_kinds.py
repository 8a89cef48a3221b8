"""Wrong values given to updating are refused; see `test_wrong_kinds`."""

from functools import cache

import numpy as np
import pytest

import flexplant as fx
from flexplant.updating import eigenvalue_sensitivities, fdac, frac, mac
from test_wrong_kinds import by_function, not_refused

POLES = [-1 + 8j, -2 + 15j]
AT = ["1:z", "2:z"]


@cache
def chain():
    K = np.array([[200.0, -110, 0], [-110, 180, -70], [0, -70, 130]])
    dofs = fx.DofSet([1, 2, 3], ["z"] * 3, [[float(i), 0, 0] for i in range(3)])
    return fx.FEModel(np.diag([1.0, 2, 1.5]), K, 1e-3 * K, dofs=dofs)


@cache
def measured():
    return fx.MeasuredModes(chain_poles(), modes=[1, 2, 3], covariance=[1e-4] * 3)


def chain_poles():
    form = fx.solve_modes(chain(), count=3)
    return 1j * form.omega * 1.001 - 0.1


@cache
def frf():
    data = np.array([1.0, 0.5 - 0.1j, -0.3])[None, None]
    return fx.Frf([0.5, 1.0, 2.0], data, inputs=["1:z"], outputs=["2:z"])


MASS = (fx.AddedMass("2:z"),)


def data():
    return [fx.Eigenvalues(measured())]


@cache
def fit():
    rough = fx.MeasuredModes(chain_poles(), modes=[1, 2, 3], covariance=[1.0] * 3)
    return fx.update(chain(), MASS, [fx.Eigenvalues(rough)])


def updated(**options):
    return fx.update(
        options.pop("model", chain()),
        options.pop("parameters", MASS),
        options.pop("residuals", data()),
        **options,
    )


def shapes(**options):
    given = {"shapes": [[1.0, 1.0], [1.4, -0.7]], "at": AT} | options
    return fx.ModeShapes(fx.MeasuredModes(POLES, modes=[1, 2]), **given)


def located(**options):
    pool = options.pop("candidates", [fx.AddedMass(f"{i}:z") for i in (1, 2, 3)])
    return fx.updating.localise(chain(), pool, options.pop("residuals", data()), **options)


def region(**options):
    given = {"regions": {"a": np.ones((2, 2), bool)}, "value": 1.0} | options
    return fx.MatrixParameter.regions(
        given.pop("build", lambda E: plate(E)), given.pop("regions"), **given
    )


def plate(E):
    return fx.kirchhoff_plate(
        size=(1, 1), thickness=0.02, elements=(2, 2), density=1.0, youngs_modulus=E, poisson_ratio=0
    )


def difference(**options):
    given = {"build": lambda v: plate(v), "value": 1.0} | options
    return fx.MatrixParameter.from_difference("a", given.pop("build"), **given)


#: (name, call of one argument, kinds that are allowed there)
CALLS = [
    ("update model", lambda x: updated(model=x), ()),
    ("update parameters", lambda x: updated(parameters=x), ()),
    ("update a parameter", lambda x: updated(parameters=[x]), ()),
    ("update residuals", lambda x: updated(residuals=x), ()),
    ("update a residual", lambda x: updated(residuals=[x]), ()),
    ("update method", lambda x: updated(method=x), ("none",)),
    ("update start", lambda x: updated(start=x), ("none",)),
    ("update start entry", lambda x: updated(start=[x]), ("fraction", "bool", "negative")),
    ("update starts", lambda x: updated(starts=x), ("none",)),
    ("update rng", lambda x: bounded(rng=x), ("none",)),
    ("update prior", lambda x: bounded(prior=x), ("bool",)),
    ("update max_iterations", lambda x: updated(max_iterations=x), ("none",)),
    ("update tolerance", lambda x: updated(tolerance=x), ("fraction",)),
    ("AddedMass at", lambda x: fx.AddedMass(x), ("text", "dict")),
    ("AddedMass direction", lambda x: fx.AddedMass("1:z", direction=x), ()),
    ("AddedMass name", lambda x: fx.AddedMass("1:z", name=x), ("text",)),
    ("AddedMass to", lambda x: fx.AddedMass("1:z", to=x), ("text", "none", "dict")),
    ("AddedMass bounds", lambda x: fx.AddedMass("1:z", bounds=x), ("none",)),
    ("AddedMass prior", lambda x: fx.AddedMass("1:z", prior=x), ("none",)),
    ("MatrixParameter name", lambda x: fx.MatrixParameter(x, dK=np.eye(3)), ("text",)),
    ("MatrixParameter dK", lambda x: fx.MatrixParameter("a", dK=x), ()),
    ("MatrixParameter unit", lambda x: fx.MatrixParameter("a", dK=np.eye(3), unit=x), ("text",)),
    ("from_difference build", lambda x: difference(build=x), ()),
    ("from_difference value", lambda x: difference(value=x), ("fraction", "negative", "bool")),
    ("from_difference step", lambda x: difference(step=x), ("none", "fraction")),
    ("regions build", lambda x: region(build=x), ()),
    ("regions regions", lambda x: region(regions=x), ()),
    ("regions a region", lambda x: region(regions={"a": x}), ("bool",)),
    ("regions value", lambda x: region(value=x), ("fraction", "negative", "bool")),
    ("ModeDamping", lambda x: fx.updating.ModeDamping(x), ()),
    ("Eigenvalues", lambda x: fx.Eigenvalues(x), ()),
    ("Eigenvalues weights", lambda x: fx.Eigenvalues(measured(), weights=x), ("none",)),
    ("Eigenvalues clusters", lambda x: fx.Eigenvalues(measured(), clusters=x), ("fraction",)),
    ("Eigenvalues select", lambda x: fx.Eigenvalues(measured()).select(x), ()),
    ("ModeShapes", lambda x: fx.ModeShapes(x), ()),
    ("ModeShapes shapes", lambda x: shapes(shapes=x), ()),
    ("ModeShapes at", lambda x: shapes(at=x), ()),
    ("ModeShapes direction", lambda x: shapes(direction=x), ()),
    ("ModeShapes std", lambda x: shapes(std=x), ("none", "fraction", "bool")),
    ("ModeShapes covariance", lambda x: shapes(covariance=x), ("none",)),
    ("ModeShapes assign", lambda x: shapes(assign=x), ("bool",)),
    ("ModeShapes select", lambda x: shapes().select(x), ()),
    ("FrfResidual", lambda x: fx.FrfResidual(x), ()),
    ("FrfResidual variance", lambda x: fx.FrfResidual(frf(), variance=x), ("none", "fraction")),
    ("FrfResidual lines", lambda x: fx.FrfResidual(frf(), lines=x), ("none",)),
    ("FrfResidual places", lambda x: fx.FrfResidual(frf(), places=x), ("none",)),
    ("FrfResidual direction", lambda x: fx.FrfResidual(frf(), direction=x), ()),
    ("FrfResidual magnitude", lambda x: fx.FrfResidual(frf(), magnitude=x), ("bool",)),
    ("FrfResidual hold", lambda x: fx.FrfResidual(frf(), hold=x), ("none",)),
    ("FrfResidual delay", lambda x: fx.FrfResidual(frf(), hold=50.0, delay=x), ("fraction",)),
    ("FrfResidual select", lambda x: fx.FrfResidual(frf()).select(x), ()),
    ("Antiresonances", lambda x: fx.updating.Antiresonances(x, "1:z", "2:z"), ()),
    (
        "Antiresonances output",
        lambda x: fx.updating.Antiresonances([3j], x, "1:z"),
        ("text", "dict"),
    ),
    (
        "Antiresonances std",
        lambda x: fx.updating.Antiresonances([3j], *AT, std=x),
        ("none", "fraction", "bool"),
    ),
    (
        "Antiresonances hold",
        lambda x: fx.updating.Antiresonances([3j], *AT, hold=x),
        ("none", "fraction"),
    ),
    ("Antiresonances direction", lambda x: fx.updating.Antiresonances([3j], *AT, direction=x), ()),
    (
        "StaticCompliance",
        lambda x: fx.updating.StaticCompliance(x, *AT),
        ("fraction", "negative", "bool"),
    ),
    (
        "StaticCompliance std",
        lambda x: fx.updating.StaticCompliance(1.0, *AT, std=x),
        ("none", "fraction"),
    ),
    (
        "StaticCompliance input",
        lambda x: fx.updating.StaticCompliance(1.0, "1:z", x),
        ("text", "dict"),
    ),
    ("localise model", lambda x: fx.updating.localise(x, MASS, data()), ()),
    ("localise residuals", lambda x: located(residuals=x), ()),
    ("localise candidates", lambda x: located(candidates=x), ()),
    ("localise nuisance", lambda x: located(nuisance=x), ()),
    ("localise most", lambda x: located(most=x), ()),
    ("localise screen", lambda x: located(screen=x), ()),
    ("identifiability", lambda x: fx.updating.identifiability(x, MASS, data()), ()),
    ("identifiability parameters", lambda x: fx.updating.identifiability(chain(), x, data()), ()),
    ("identifiability residuals", lambda x: fx.updating.identifiability(chain(), MASS, x), ()),
    ("sensitivities", lambda x: eigenvalue_sensitivities(x, MASS), ()),
    ("sensitivities modes", lambda x: eigenvalue_sensitivities(chain(), MASS, modes=x), ("none",)),
    ("correlate", lambda x: fx.updating.correlate(x, data()), ()),
    ("correlate residuals", lambda x: fx.updating.correlate(chain(), x), ()),
    ("mac", lambda x: mac(x, x), ()),
    ("frac", lambda x: frac(x, x), ()),
    ("fdac", lambda x: fdac(x, x), ()),
    ("split", lambda x: fx.updating.split(x), ()),
    ("split share", lambda x: fx.updating.split(data()[0], share=x), ()),
    ("split rng", lambda x: fx.updating.split(data()[0], rng=x), ("none",)),
    ("TrustRegion loss", lambda x: fx.updating.TrustRegion(loss=x), ()),
    ("GaussNewton truncate", lambda x: fx.updating.GaussNewton(truncate=x), ()),
    ("interval", lambda x: fit().interval(x), ()),
]


def bounded(**options):
    return updated(parameters=[fx.AddedMass("2:z", bounds=(-0.5, 1.0))], **options)


GROUPS = by_function(CALLS)


@pytest.mark.parametrize("function", GROUPS)
def test_a_wrong_kind_is_refused_with_a_next_step(function):
    wrong = not_refused(GROUPS[function])
    assert not wrong, "\n".join(wrong)
