"""Every public name says what it does, what it takes and what it raises."""

import ast
import dataclasses
import inspect
import re
from operator import attrgetter
from pathlib import Path
from types import ModuleType

import pytest

import flexplant
from flexplant import algorithms
from flexplant.documentation import rooms
from flexplant.errors import FlexplantError


def is_public(name, item):
    ours = getattr(item, "__module__", "flexplant").split(".")[0] == "flexplant"
    return ours and not name.startswith("_") and not isinstance(item, ModuleType)


#: the whole front: what the examples and the README use and what users construct day by day;
#: anything else stays in its room (`flexplant.lti.tustin`)
FRONT = """
FlexplantError FlexplantWarning load
read_model read_matrices check DofSet FEModel plate kirchhoff_plate beam chain solid_block
interpolated PointMass Spring Damper ModalDamping
solve_modes Modes reduce ReducedModel DesiredDofs ModalBalanced
select_dofs
joined
estimate_frf identify_modes numbered MeasuredModes
update UpdateResult AddedMass AddedDamping AddedStiffness MatrixParameter Eigenvalues ModeShapes
FrfResidual
Ports Actuator Disturbance BaseAcceleration Sensor Poi Reference
assemble_plant StandardPlant decouple stage_weights reference_errors
StateSpace Frf frequency_response h2_norm hinf_norm peak_gain lft balanced minimal modal_form
design_kalman design_static KalmanEstimator
design_servo servo_bandwidth design_h2 design_hinf design_stage design_ncf
Riccati Lmi Controller Pid Lead Notch LowPass design_loops tune_loops
score_sensors place_sensors place_actuators PoiVariance Placement
close_loop ClosedLoop compare_loops modulus_margin
setpoint simulate Response Specification study design_feedforward
show_versions
Dampings Delay Frequencies Gains GeneralizedPlant Neglected
"""
ROOMS = {
    *(
        "lti",
        "sparse",
        "structure",
        "modes",
        "reduction",
        "joining",
        "identification",
        "updating",
        "plant",
    ),
    *(
        "loop",
        "estimation",
        "synthesis",
        "placement",
        "simulation",
        "testbeds",
        "io",
        "export",
        "errors",
    ),
    "plot",
    "workbench",
}


def of(module):
    return {name: item for name, item in vars(module).items() if is_public(name, item)}


#: the front and what only the rooms show
PUBLIC = of(flexplant)
for room in sorted(ROOMS - {"errors", "plot"}):
    PUBLIC |= of(getattr(flexplant, room))
CLASSES = {name: item for name, item in PUBLIC.items() if inspect.isclass(item)}
PICTURES = {name: item for name, item in of(flexplant.plot).items() if inspect.isfunction(item)}
FUNCTIONS = {name: item for name, item in PUBLIC.items() if inspect.isfunction(item)}
ERRORS = {n for n, c in CLASSES.items() if issubclass(c, BaseException)}
CONSTRUCTORS = {name: item for name, item in CLASSES.items() if name not in ERRORS}
DOCUMENTED = FUNCTIONS | CONSTRUCTORS
METHODS = {
    f"{owner}.{name}": getattr(item, name)
    for owner, item in CONSTRUCTORS.items()
    for name, member in vars(item).items()
    if not name.startswith("_") and (inspect.isfunction(member) or isinstance(member, classmethod))
}


def sections(item):
    """Return {title: text} of a numpydoc docstring."""
    doc = inspect.cleandoc(item.__doc__ or "")
    parts = re.split(r"^(\w[\w ]*)\n-{3,}$", doc, flags=re.MULTILINE)
    return dict(zip(parts[1::2], parts[2::2], strict=True))


def parameters(item):
    if getattr(item, "_is_protocol", False):  # nobody makes one
        return []
    return [p for p in inspect.signature(item).parameters.values() if p.name not in ("self", "cls")]


def listed(text):
    """Return the names that a Parameters section describes: `u, y : ...` describes two."""
    heads = re.findall(r"^(\*{0,2}\w[\w, *]*?)(?: : .*)?$", text, flags=re.MULTILINE)
    return {name.strip(" *") for head in heads for name in head.split(",")}


def test_the_front_is_small():
    """A name that joins the front is used by an example, the README or every second user."""
    assert set(of(flexplant)) == set(FRONT.split())
    assert len(FRONT.split()) <= 101
    assert set(dir(flexplant)) == ROOMS.union(FRONT.split())
    with pytest.raises(AttributeError, match=r"Use flexplant\.lti\.tustin\.$"):
        _ = flexplant.tustin
    with pytest.raises(AttributeError, match=r"no attribute 'Tustin'\.$"):
        _ = flexplant.Tustin


def test_no_names_differ_by_case_alone():
    """A value and a verb of one name are told apart by more than a capital letter."""
    rooms = {name: getattr(flexplant, name) for name in sorted(ROOMS - {"errors", "plot"})}
    known = {name for room in rooms.values() for name in dir(room)} | set(FRONT.split())
    folded = {}
    for name in sorted(known):
        folded.setdefault(name.lower(), []).append(name)
    assert [names for names in folded.values() if len(names) > 1] == []


@pytest.mark.parametrize("name", sorted(ROOMS - {"errors"}))
def test_a_room_shows_what_it_is_for(name):
    """Completion offers public names, not the modules behind them."""
    room = getattr(flexplant, name)
    shown = {n for n, item in vars(room).items() if not isinstance(item, ModuleType)}
    assert set(dir(room)) == {n for n in shown if not n.startswith("_")}
    assert dir(room)


def test_dir_of_a_value_shows_what_it_is_for():
    frf = flexplant.Frf([1.0], [[[1.0]]])
    shown = dir(frf)
    assert {"freq", "data", "select", "save", "keys", "window"} <= set(shown)
    assert not [name for name in shown if name.startswith("_") or name == "registry"]


def described(name, item):
    """Return what is wrong with the docstring of a class or a function, or None."""
    doc = vars(item).get("__doc__") if inspect.isclass(item) else item.__doc__
    if not doc or not doc.strip():
        return f"{name} has no docstring"
    # what dataclass writes when there is none
    return f"{name} has no docstring of its own" if doc.startswith(f"{name}(") else None


def parameters_described(name, item):
    wanted = [p.name for p in parameters(item)]
    listed_ones = listed(sections(item).get("Parameters", ""))
    missing = [p for p in wanted if p not in listed_ones]
    return f"{name} does not describe {missing} under Parameters" if missing else None


def raises_named(name, item):
    if not parameters(item):
        return None
    raised = sections(item).get("Raises", "")
    heads = re.findall(r"^(\w[\w, ]*)$", raised, re.MULTILINE)
    names = {n for head in heads for n in head.split(", ")}
    known = {c.__name__ for c in all_errors(FlexplantError)} | {"OSError", "FileNotFoundError"}
    if not names & known:
        return f"{name} does not say under Raises which errors a wrong use meets"
    if names - known:
        return f"{name} names {sorted(names - known)}, which are no errors of ours"
    return None


def keywords_closed(name, item):
    # the names of positions are the user's own, and checked: plant.at(x=0.03); so are the fields
    # that `replace` changes
    known = {"positions", "changes"}
    open_ones = [p for p in parameters(item) if p.kind is p.VAR_KEYWORD and p.name not in known]
    return f"{name} takes **keywords" if open_ones else None


#: what stands by place though it has a default that is a number or a name, or is the second such:
#: these are said together
TOGETHER = {
    "direction",  # after a place: dofs.nearest(xyz, "rx")
    "directions",  # after the nodes, as in dofs.where(nodes, "z")
    *("length", "mass", "time"),  # the units of a model: matrices.converted("mm", "t")
    "inputs",  # after the outputs, as in frf["y1", "u1"]
    "dt",  # of a transfer function, as in python-control
    "freq",  # after what the response is of
    "parameters",  # after the fit, as in `update`
    "n",  # after the seed
    "level",  # after what the interval is of: observer.interval("die:z", 0.95)
}


def options_by_name(name, item):
    """By place stands what an item acts on: up to four, then one method, model or criterion."""
    placed = [p for p in parameters(item) if p.kind is p.POSITIONAL_OR_KEYWORD]
    optional = [p for p in placed if p.default is not p.empty and p.name not in TOGETHER]
    if len(placed) - len(optional) > 4 or len(optional) > 1:
        return f"{name} takes {[p.name for p in placed]} by place"
    scalar = optional and isinstance(optional[0].default, int | float | str)
    return f"{name} takes {optional[0].name} by place" if scalar and len(placed) > 1 else None


def all_errors(base):
    return {base}.union(*(all_errors(sub) for sub in base.__subclasses__()))


DESCRIBED = {n: i for n, i in PUBLIC.items() if inspect.isclass(i) or inspect.isroutine(i)}


@pytest.mark.parametrize(
    ("check", "items"),
    [
        (described, DESCRIBED | METHODS),
        (parameters_described, DOCUMENTED),
        (raises_named, FUNCTIONS),
        (keywords_closed, DOCUMENTED | METHODS),
        (options_by_name, FUNCTIONS | PICTURES | METHODS),
    ],
)
def test_every_public_name(check, items):
    wrong = [line for name, item in items.items() if (line := check(name, item))]
    assert not wrong, "\n".join(wrong)


def test_the_checks_can_fail():
    def bad(first, second, **rest):
        """Do things.

        Parameters
        ----------
        first : int
            One.
        """

    assert parameters_described("bad", bad) == (
        "bad does not describe ['second', 'rest'] under Parameters"
    )
    assert raises_named("bad", bad).startswith("bad does not say under Raises")
    assert keywords_closed("bad", bad) == "bad takes **keywords"
    assert options_by_name("bad", bad) is None
    assert options_by_name("one", lambda level=0.9: level) is None
    assert options_by_name("x", lambda a, b=1: a) == "x takes b by place"
    assert options_by_name("x", lambda a=None, b=None: a) == "x takes ['a', 'b'] by place"
    assert options_by_name("x", lambda a, b, c, d, e: a) is not None
    assert described("bad", bad) is None
    assert described("x", lambda: None) == "x has no docstring"
    assert [p.name for p in parameters(bad)] == ["first", "second", "rest"]


#: names in errors that are not those of this package: of lists, of texts, of a room's own words
ELSEWHERE = {"append", "split", "matched", "Filter", "LoopLimits"}


@pytest.mark.slow
@pytest.mark.static
def test_names_in_advice_are_at_the_front_or_have_their_room():
    """`GroundSpring` in an error sends a reader to search; `fx.plant.GroundSpring` does not."""
    homes = {n: room for room, where in rooms().items() for n in dir(where) if room != "errors"}
    hidden = set(homes) - set(dir(flexplant)) - ELSEWHERE
    bare = []
    for path in Path(flexplant.__file__).parent.rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Raise):
                texts = (c.value for c in ast.walk(node) if isinstance(c, ast.Constant))
                advice = " ".join(text for text in texts if isinstance(text, str))
                found = set(re.findall(r"(?<![\w.'])([A-Za-z_]\w+)\(", advice)) & hidden
                bare += [f"{path.name}:{node.lineno}: {homes[n]}.{n}" for n in sorted(found)]
    assert not bare


@pytest.mark.slow
@pytest.mark.static
def test_tests_import_public_names_where_users_do():
    """From the front or a room: a name that moves between modules moves no test."""
    shown = {n: room for room, where in rooms().items() for n in dir(where) if room != "errors"}
    inner = []
    for path in Path(__file__).parent.rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            place = (getattr(node, "module", None) or "").split(".")
            if place[0] == "flexplant" and (len(place) > 2 or place[1:] == ["store"]):
                public = {shown.get(one.name) for one in node.names} & set(place)
                public |= {one.name for one in node.names} & {"load"}
                inner += [f"{path.name}:{node.lineno}: {'.'.join(place)}"] if public else []
    assert not inner


@pytest.mark.parametrize(
    "verb", ["identify_modes", "updating.localise", "update", "design_hinf", "tune_loops"]
)
def test_the_first_lines_let_one_use_it(verb):
    """A call and what it gives back, in at most a dozen lines; how it works is on a page."""
    said = inspect.getdoc(attrgetter(verb)(flexplant))
    opening = said[: said.index("\nParameters\n")]
    assert len(opening.splitlines()) <= 12
    assert f"fx.{verb}(" in opening and "`algorithms`" in opening
    assert f"**{verb.rpartition('.')[2]}.**" in algorithms.__doc__
    # names of the answer that are promised are there
    call = re.search(rf"``(\w+) = fx\.{verb}\(", " ".join(opening.split()))
    answer = inspect.signature(attrgetter(verb)(flexplant)).return_annotation
    kinds = {n: item for room in rooms().values() for n, item in vars(room).items()}
    fields = {field.name for field in dataclasses.fields(kinds[answer])} | set(dir(kinds[answer]))
    for name in re.findall(rf"`{call[1]}\.(\w+)", opening):
        assert name in fields, name
