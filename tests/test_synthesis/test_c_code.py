"""The C of controllers: compiled with strict warnings, run against machines, beside simulate."""

import ctypes
import itertools
import shutil
import subprocess
from functools import cache

import numpy as np
import pytest
import scipy.linalg as la
from test_aftercare import designed, pi_controller, plant

import flexplant as fx
from flexplant.errors import (
    AssumptionError,
    CertificateError,
    FlexplantWarning,
    LabelError,
    ModelError,
)
from flexplant.export import write_c
from flexplant.lti import StateSpace
from flexplant.simulation import Saturation
from flexplant.synthesis import anti_windup_form
from flexplant.synthesis.aftercare.forms import two_state_form
from oracles_lti import periodic_answer

COMPILER = shutil.which("cc") or shutil.which("gcc")
STRICT = ["-std=c99", "-pedantic", "-Wall", "-Wextra", "-Wconversion", "-Wshadow"]
STRICT += ["-Wdouble-promotion", "-Werror"]
compiles = pytest.mark.skipif(COMPILER is None, reason="no C compiler")
numbers = itertools.count()


class Compiled:
    """A written controller, compiled, called sample by sample."""

    def __init__(self, folder, controller, **options):
        name = f"stage{next(numbers)}"
        source, header = write_c(controller, folder / f"{name}.c", **options)
        self.text = source.read_text() + header.read_text()
        library = folder / f"{name}.so"
        looks = folder / f"{name}_looks.c"  # what else of the structure is public
        looks.write_text(
            f'#include "{name}.h"\nint {name}_fault(const {name}_t *s);\n'
            f"unsigned long {name}_faults(const {name}_t *s);\n"
            f"int {name}_fault(const {name}_t *s) {{ return s->fault; }}\n"
            f"unsigned long {name}_faults(const {name}_t *s) {{ return s->faults; }}\n"
        )
        command = [COMPILER, *STRICT, "-O2", "-shared", "-fPIC", str(source), str(looks)]
        command += ["-o", str(library)]
        subprocess.run(command, check=True)
        self.calls = {
            part: getattr(ctypes.CDLL(str(library)), f"{name}_{part}")
            for part in ("reset", "start", "output", "update", "step", "fault", "faults")
        }
        kind = np.float32 if options.get("single") else np.float64
        read = {
            part: int(line.split()[-1])
            for line in self.text.splitlines()
            for part in ("INPUTS", "OUTPUTS", "DRIVEN", "STATES")
            if line.startswith(f"#define {name.upper()}_{part}")
        }
        self.read, self.kind = read, kind
        self.state = ctypes.create_string_buffer(100_000)
        self.out = np.zeros(read["OUTPUTS"], kind)
        self.calls["reset"](self.state)

    def __call__(self, values, part="step"):
        given = np.ascontiguousarray(values, self.kind)
        assert given.size == self.read["INPUTS"]
        self.given = given
        pointers = [ctypes.c_void_p(a.ctypes.data) for a in (given, self.out)]
        self.calls[part](self.state, *pointers[: 1 if part == "update" else 2])
        return self.out.copy()

    @property
    def faults(self):
        """The flag of the last sample, and how many samples had it."""
        return tuple(int(self.calls[part](self.state)) for part in ("fault", "faults"))

    def start(self, values, applied):
        given, held = (np.ascontiguousarray(part, self.kind) for part in (values, applied))
        pointers = [ctypes.c_void_p(a.ctypes.data) for a in (given, held)]
        self.calls["start"](self.state, *pointers)


def closed(run_plant, code, names, references, samples, apply=lambda u: u):
    """The controller in C in the loop with a plant in NumPy: commands and outputs, by samples."""
    g = run_plant.system
    B, C = g.B[:, g.input_index(names)], g.C[g.output_index(run_plant.y)]
    enter = g.D[np.ix_(g.output_index(run_plant.y), g.input_index(list(references)))]
    Br = g.B[:, g.input_index(list(references))]
    x, found = np.zeros(g.n_states), []
    for k in range(samples):
        r = np.array([signal[k] for signal in references.values()])
        out = code(C @ x + enter @ r)
        found.append(out)
        x = g.A @ x + B @ apply(out[: len(names)]) + Br @ r
    return np.array(found)


def agree(got, run, driven, watched, rtol):
    """To the size of all commands, and of all estimates: a tilt that is symmetry is rounding."""
    count = len(driven)
    for names, part in ((driven, got[:, :count]), (watched, got[:, count:])):
        wanted = np.array([run[name] for name in names]).T
        size = np.abs(wanted).max(initial=0.0)
        np.testing.assert_allclose(part, wanted, rtol=0, atol=rtol * size)


@cache
def readme():
    """Plate, ports, plant, observer and servo of README's script, without its update."""
    length, damping = 0.6, fx.ModalDamping(0.01)
    plate = fx.kirchhoff_plate(
        size=(length, length), thickness=0.0272, elements=(8, 8), density=2702,
        youngs_modulus=70e9, poisson_ratio=0.35,
    )  # fmt: skip
    z8 = plate.dofs.nearest((length / 2, length / 4, 0.0), "z")
    plate = plate.with_parts(fx.PointMass(z8, 0.5))
    modes = fx.solve_modes(plate, count=24, damping=damping)
    corners = [(x, y, 0.0) for y in (0.0, length) for x in (0.0, length)]
    inset = [(x, y, 0.0) for y in (0.15, 0.45) for x in (0.15, 0.45)]
    ports = fx.Ports(
        w=[fx.Disturbance(f"amp{i}", at=p, asd=1e-3) for i, p in enumerate(inset, 1)],
        u=[fx.Actuator(f"u{i}", at=p) for i, p in enumerate(inset, 1)],
        z=[fx.Poi("die", at=(0.3, 0.3, 0.0), axes=("z", "rx", "ry"))],
        y=[fx.Sensor(f"y{i}", at=p, asd=1.4e-12) for i, p in enumerate(corners, 1)],
        references=[fx.Reference("die")],
    )
    made = fx.assemble_plant(modes, ports).discretized(10e3, delay=1.3)
    observer = fx.design_kalman(made)
    servo = fx.design_servo(made, bandwidth=50.0, observer=observer)
    return ports, made, observer, servo, fx.testbeds.wafer_stage(damping=0.01)


@compiles
@pytest.mark.slow
@pytest.mark.parametrize("kind", ["observer and servo", "H-infinity"])
def test_readmes_design_runs_in_c_against_the_virtual_machine(kind, tmp_path):
    """The loop closed around the C gives the run of `simulate` to 1e-9, and holds the machine."""
    ports, made, observer, servo, machine = readme()
    blocks = (observer, servo)
    if kind == "H-infinity":
        errors, weights = fx.reference_errors(made), fx.stage_weights(made, 40.0)
        weighted = made.through(errors).weighted(z=weights.z, w=weights.w)
        blocks = (errors, fx.design_hinf(weighted))
    loop = machine.loop(ports, *blocks)
    assert loop.is_stable
    code = Compiled(tmp_path, loop)
    move = fx.setpoint(100e-6, velocity=5e-3, acceleration=0.5, jerk=100.0)
    run = fx.simulate(loop, reference=move, duration=0.1, noise=False)
    refs = {"die:ref": move.at(run.time).position}
    agree(
        closed(loop.plant, code, loop.driven, refs, run.time.size),
        run,
        loop.driven,
        loop.watched,
        1e-9,
    )
    # and with noise, from what its sensors read
    run = fx.simulate(loop, reference=move, duration=0.1, rng=3)
    again = Compiled(tmp_path, loop)
    got = np.array([again(np.array([run[name][k] for name in loop.plant.y])) for k in range(1000)])
    agree(got, run, loop.driven, loop.watched, 1e-9)


@compiles
@pytest.mark.slow
@pytest.mark.parametrize(
    ("kind", "bandwidth"),
    [("gantry", 4.0), ("hexapod", 4.0), ("dual_stage", 10.0), ("ball_screw", 5.0)],
)
def test_driven_machines_run_in_c(kind, bandwidth, tmp_path):
    """Also laws of six axes on springs, whose slow poles no change of states keeps."""
    made = getattr(fx.testbeds, kind)()
    observer = fx.design_kalman(made)
    servo = fx.design_servo(made, bandwidth=bandwidth, observer=observer)
    loop = fx.close_loop(made, observer, servo)
    led = [name for name in made.y if name.endswith(":ref")]
    move = fx.setpoint(1e-4, velocity=5e-3, acceleration=0.5, jerk=100.0)
    run = fx.simulate(loop, reference={led[0]: move}, duration=0.04, noise=False)
    refs = dict.fromkeys(led, np.zeros(run.time.size)) | {led[0]: move.at(run.time).position}
    got = closed(loop.plant, Compiled(tmp_path, loop), loop.driven, refs, run.time.size)
    agree(got, run, loop.driven, loop.watched, 1e-8)


@pytest.mark.slow
@compiles
def test_an_observer_a_servo_and_feedforward_in_one_file_with_limits(tmp_path):
    """Saturated commands reach the observer, integrators return: as simulate has it."""
    given = fx.testbeds.three_masses()
    observer = fx.design_kalman(given)
    servo = fx.design_servo(given, bandwidth=20.0, observer=observer)
    forward = fx.simulation.design_feedforward(given).up_to("acceleration")
    loop = fx.close_loop(given, observer, servo, forward)
    move = fx.setpoint(1e-3, velocity=0.1, acceleration=5.0, jerk=1e3)
    most = 9.0
    free = fx.simulate(loop, reference=move, duration=0.3, noise=False)
    assert np.abs(free["u1"]).max() > 1.3 * most
    options = {"elements": {"u1": Saturation(most)}, "anti_windup": 0.02}
    with pytest.warns(FlexplantWarning, match="needs -15 to 15 N of 'u1'"):  # 3 kg at 5 m/s^2
        run = fx.simulate(loop, reference=move, duration=0.3, noise=False, **options)
    at = move.at(run.time)
    refs = {"die:ref": at.position, "die:ref:acceleration": at.acceleration}
    for limits, wanted in ((None, free), (most, run), ({"u1": (-most, most)}, run)):
        code = Compiled(tmp_path, loop, limits=limits, anti_windup=0.02)
        agree(
            closed(loop.plant, code, ["u1"], refs, run.time.size),
            wanted,
            loop.driven,
            loop.watched,
            1e-9,
        )


@pytest.mark.slow
@compiles
@pytest.mark.parametrize("single", [False, True])
def test_the_c_file_gives_what_simulate_gives(single, tmp_path):
    """Compiled with all warnings as errors; the commands of a run, from its sensor samples."""
    _, full = designed()
    code = Compiled(tmp_path, full, single=single)
    assert "malloc" not in code.text
    assert "stdlib" not in code.text
    assert ("double" in code.text) != single or "in single" in code.text
    run = fx.simulate(fx.close_loop(plant(), full), duration=2.0, rng=5)
    got = np.array([code([value])[0] for value in run["s"]])
    # single: 24 bits, in resonances that keep what rounding leaves for 1/(2 zeta) periods
    np.testing.assert_allclose(
        got, run["f"], atol=(1e-3 if single else 1e-11) * np.abs(run["f"]).max()
    )


@compiles
@pytest.mark.parametrize("kind", ["chain", "double integrator", "static", "alike", "one"])
def test_systems_without_distinct_poles(kind, tmp_path):
    """Delays in a row, integrators, equal poles: blocks of any size, or none."""
    rng = np.random.default_rng(4)
    A = {
        "chain": np.diag(np.ones(6), 1),
        "double integrator": np.array([[1.0, 0.1], [0.0, 1.0]]),
        "static": np.zeros((0, 0)),
        "alike": np.kron(np.eye(3), [[0.9, 0.2], [-0.2, 0.9]]) + np.diag([0.3, 0, 0.3, 0], 2),
        "one": np.array([[0.5]]),
    }[kind]
    n = len(A)
    T = np.linalg.qr(rng.standard_normal((n, n)))[0] if n else A
    B, C = rng.standard_normal((n, 2)), rng.standard_normal((3, n))
    K = StateSpace(T @ A @ T.T, T @ B, C @ T.T, rng.standard_normal((3, 2)), 0.01,
                   inputs=["a", "b"], outputs=["p", "q", "r"])  # fmt: skip
    code, x = Compiled(tmp_path, K), np.zeros(n)
    for k in range(40):
        given = rng.standard_normal(2)
        wanted = K.C @ x + K.D @ given
        # both ways to call it
        got = code(given, "step" if k % 2 else "output")
        if not k % 2:
            code(given, "update")
        np.testing.assert_allclose(
            got, wanted, rtol=1e-9, atol=1e-9 * (1 + np.abs(x).max(initial=0))
        )
        x = K.A @ x + K.B @ given


@pytest.mark.slow
@compiles
def test_what_is_not_finite_holds_the_outputs_and_raises_the_flag(tmp_path):
    K = pi_controller()
    code, other = Compiled(tmp_path, K), Compiled(tmp_path, K)
    last = [code([0.1 * k]) for k in range(5)][-1]
    assert code.faults == (0, 0)
    for count, bad in enumerate((np.nan, np.inf, -np.inf), 1):
        np.testing.assert_array_equal(code([bad]), last)
        assert code.faults == (1, count)
    after = [code([0.1 * k]) for k in range(5, 9)]
    wanted = [other([0.1 * k]) for k in range(9)][5:]
    np.testing.assert_array_equal(after, wanted)
    assert code.faults == (0, 3)


@compiles
def test_a_bumpless_start(tmp_path):
    """From any command and input it continues there, and rests when the input is one of rest."""
    K = pi_controller()
    code = Compiled(tmp_path, K)
    code.start([0.0], [-4.2])
    for _ in range(50):
        assert code([0.0])[0] == pytest.approx(-4.2, rel=1e-9)
    code.start([0.3], [1.5])
    assert code([0.3])[0] == pytest.approx(1.5, rel=1e-9)
    code.calls["reset"](code.state)
    assert code([0.0])[0] == 0.0


@pytest.mark.slow
@compiles
def test_limits_of_a_controller_by_itself(tmp_path):
    """Hanus' form by hand, and a controller that reads what is applied by its own name."""
    K = pi_controller()
    form = anti_windup_form(K)
    rng = np.random.default_rng(1)
    given, most = 2.0 * rng.standard_normal(300) + 1.0, 12.0
    x, wanted = np.zeros(form.n_states), []
    for value in given:
        u = float(np.clip(form.C @ x + form.D[:, 0] * value, -most, most)[0])
        x = form.A @ x + form.B @ np.array([value, u])
        wanted.append(u)
    assert np.ptp(wanted) == 2 * most
    for one in (K, form):
        code = Compiled(tmp_path, one, limits=most)
        np.testing.assert_allclose(
            [code([value])[0] for value in given], wanted, rtol=0, atol=1e-9 * most
        )
    short = Compiled(tmp_path, K, limits=(-most, 0.5 * most), single=True)
    outs = [short([value])[0] for value in given]
    assert min(outs) == -most
    assert max(outs) == 0.5 * most
    plain = Compiled(tmp_path, form)  # nothing limits: the controller itself
    other = Compiled(tmp_path, K)
    np.testing.assert_allclose(
        [plain([value])[0] for value in given], [other([value])[0] for value in given], rtol=1e-8
    )


@pytest.mark.slow
@compiles
def test_a_schedule_interpolates_the_outputs(tmp_path):
    """Gains after an integrator by place: exact at places, linear between, held beyond."""

    def law(gain):
        return StateSpace([[1.0]], [[0.01, 0.0]], [[2.0 * gain]], [[gain, 0.1]], 0.01,
                          inputs=["e", "x"], outputs=["u"])  # fmt: skip

    laws = {0.2: law(5.0), 0.0: law(1.0), 0.1: law(2.0)}
    code = Compiled(tmp_path, laws, schedule="x")
    single = Compiled(tmp_path, laws, schedule="x", single=True)
    state = 0.0
    for place in (-1.0, 0.0, 0.03, 0.1, 0.15, 0.2, 7.0):
        gain = np.interp(place, [0.0, 0.1, 0.2], [1.0, 2.0, 5.0])
        wanted = 2.0 * gain * state + gain * 0.5 + 0.1 * place
        assert code([0.5, place])[0] == pytest.approx(wanted, rel=1e-12)
        assert single([0.5, place])[0] == pytest.approx(wanted, rel=1e-5)
        state += 0.005
    code.start([0.0, 0.1], [3.0])
    assert code([0.0, 0.1])[0] == pytest.approx(3.0, rel=1e-9)
    with pytest.raises(ModelError, match="Leave limits out"):
        write_c(laws, tmp_path / "limited.c", schedule="x", limits=2.0, anti_windup=0.1)
    ahead = {place: law(1.0).replace(D=[[place, 0.1]]) for place in (0.0, 0.2)}
    limited = Compiled(tmp_path, ahead, schedule="x", limits=2.0, anti_windup=0.1)
    assert limited([9.0, 0.2])[0] == pytest.approx(0.2 * 9.0 + 0.1 * 0.2)
    assert limited([90.0, 0.2])[0] == 2.0
    other = law(1.0).replace(A=[[0.9]])
    with pytest.raises(ModelError, match=r"more than its outputs \(A\)"):
        write_c({0.0: law(1.0), 1.0: other}, tmp_path / "a.c", schedule="x")
    with pytest.raises(LabelError, match="input of the schedule"):
        write_c({0.0: law(1.0), 1.0: law(2.0)}, tmp_path / "a.c", schedule="y")


def moving_plant(rate, noise, count=5):
    """A plate whose point of interest and sensors move along x."""
    plate = fx.kirchhoff_plate(
        size=(0.6, 0.6), thickness=0.0272, elements=(4, 4), density=2702, youngs_modulus=70e9,
        poisson_ratio=0.35,
    )  # fmt: skip
    corners = [(x, y, 0.0) for y in (0.1, 0.5) for x in (0.2, 0.4)]
    ports = fx.Ports(
        u=[fx.Actuator(f"u{i}", at=p, asd=1e-3) for i, p in enumerate(corners)],
        z=[fx.Poi("die", at=(0.3, 0.3, 0.0), axes=("z", "rx", "ry"), moves={"x": (-1, 0, 0)})],
        y=[
            fx.Sensor(f"y{i}", at=p, asd=noise, moves={"x": (-1, 0, 0)})
            for i, p in enumerate(corners)
        ],
        references=[fx.Reference("die")],
        positions=[fx.plant.Position("x", range=(-0.1, 0.1))],
    )
    modes = fx.solve_modes(plate, count=count, damping=fx.ModalDamping(0.01))
    return fx.assemble_plant(modes, ports).discretized(rate, delay=1)


def follow(there):
    """Return an observer and a servo for one place of `moving_plant`."""
    return fx.design_kalman(there), fx.design_servo(there, bandwidth=20.0, notches=[])


@pytest.mark.slow
@compiles
@pytest.mark.parametrize(
    "rate, noise, count", [(4e3, 1e-10, 5), (20e3, 1e-8, 5), (100e3, 1e-10, 7)]
)
def test_double_precision_is_not_refused_for_the_rounding_of_a_comparison(
    tmp_path, rate, noise, count
):
    """Two responses of these differ by 4e-8 to 2e-6; the C is the interpolated controller."""
    schedule = fx.loop.schedule_loops(
        moving_plant(rate, noise, count), follow, places=[-0.1, 0.0, 0.1]
    )
    laws = [one.controller for one in schedule.loops]
    rng = np.random.default_rng(int(rate))
    given, place = rng.standard_normal((200, len(laws[0].inputs))), rng.uniform(-0.1, 0.1, 200)
    state, wanted = np.zeros(laws[0].n_states), []
    for sample, q in zip(given, place, strict=True):
        k, share = divmod((q + 0.1) / 0.1, 1.0)
        A, B, C, D = (
            (1 - share) * getattr(laws[int(k)], part) + share * getattr(laws[int(k) + 1], part)
            for part in "ABCD"
        )
        wanted.append(C @ state + D @ sample)
        state = A @ state + B @ sample
    code = Compiled(tmp_path, schedule)
    got = np.array([code([*sample, q]) for sample, q in zip(given, place, strict=True)])
    size = np.abs(wanted).max(axis=0)
    np.testing.assert_allclose(got / size, np.array(wanted) / size, rtol=0, atol=1e-10)


@pytest.mark.parametrize("part", ["rest", "B", "C", "D"])
def test_a_wrong_entry_of_a_schedule_is_found(monkeypatch, part):
    """The certificate of a form that follows a place, fed entries that are off by 1e-6."""
    from flexplant.synthesis.aftercare import forms

    right = forms._arranged

    def wrong(*args, **options):
        form = right(*args, **options)
        return form._replace(**{part: (1 + 1e-6) * getattr(form, part)})

    monkeypatch.setattr(forms, "_arranged", wrong)
    law = StateSpace([[0.9, 0.1], [-0.1, 0.9]], [[1.0], [0.5]], [[1.0, 0.2]], [[5.0]], 1e-3)
    with pytest.raises(CertificateError, match="not copied as they are"):
        forms.scheduled_form([law, law], driven=1)


@pytest.mark.slow
@compiles
def test_a_controller_that_follows_its_machine_on_a_path(tmp_path):
    """The commands of `simulate` along a path, from its readings and positions."""
    moving = moving_plant(4e3, 1e-12)
    schedule = fx.loop.schedule_loops(moving, follow, places=np.linspace(-0.1, 0.1, 5))
    move = fx.setpoint(0.1, velocity=0.8, acceleration=20.0, jerk=4e3)
    run = fx.simulate(schedule, duration=0.1, moving={"x": move}, rng=1)
    law = schedule.loops[0].controller
    given = [run[name] if name in run.names else np.zeros(run.time.size) for name in law.inputs]
    readings = np.array([*given, move.at(run.time).position]).T
    wanted = np.array([run[name] for name in schedule.loops[0].driven]).T
    for single, rtol in ((False, 1e-9), (True, 1e-3)):
        code = Compiled(tmp_path, schedule, single=single)
        got = np.array([code(row)[:4] for row in readings])
        np.testing.assert_allclose(got, wanted, rtol=0, atol=rtol * np.abs(wanted).max())
    frozen = Compiled(tmp_path, schedule)
    off = np.array([frozen([*row[:-1], 0.0])[:4] for row in readings])
    assert np.abs(off - wanted).max() > 0.01 * np.abs(wanted).max()
    frozen.start(readings[0], wanted[0])  # bumpless: what acts now goes on
    np.testing.assert_allclose(
        frozen(readings[0])[:4], wanted[0], rtol=0, atol=1e-6 * np.abs(wanted[0]).max()
    )
    with pytest.raises(ModelError, match="saturate outside"):
        write_c(schedule, tmp_path / "limited.c", limits=2.0)


@pytest.mark.parametrize("order", [1, 2, 3])
def test_every_state_of_a_schedule_follows_the_place(order):
    """Also where there are so few that one system's would be a pair."""
    from flexplant.lti.response_solvers import responses
    from flexplant.synthesis.aftercare.forms import TwoStateForm, scheduled_form

    A = np.array([[0.9, 0.1, 0.0], [-0.1, 0.9, 0.1], [0.0, 0.0, 0.5]])[:order, :order]
    B, C = np.array([[1.0], [0.5], [0.2]])[:order], np.array([[1.0, 0.2, 0.7]])[:, :order]
    laws = [StateSpace(k * A, B, C, [[0.1]], 1e-3) for k in (1.0, 0.8)]
    form, freq = scheduled_form(laws, driven=1), np.array([1.0, 30.0, 300.0])
    for q, K in enumerate(laws):
        rows = slice(q, q + 1)
        one = TwoStateForm(
            form.pairs, form.rest[q], form.B[q], form.C[rows], form.D[rows], form.start, 0.0
        )
        np.testing.assert_allclose(one.response(freq, 1e-3), responses(K, freq), rtol=1e-12)


def test_refusals_of_the_c_export(tmp_path):
    slow = StateSpace([[0.5]], [[1.0]], [[1.0]], [[0.0]], 0.01, inputs=["s"], outputs=["f"])
    reads = StateSpace([[0.5]], [[1.0, 0.0]], [[1.0]], [[0.0, 1.0]], 0.01,
                       inputs=["s", "f"], outputs=["f"])  # fmt: skip
    path = tmp_path / "a.c"
    for error, cause, call in (
        (
            LabelError,
            "is not allowed as a function name in C",
            lambda: write_c(designed()[1], tmp_path / "1st.c"),
        ),
        (
            LabelError,
            "is not allowed as a function name in C",
            lambda: write_c(designed()[1], path, name="while"),
        ),
        (ModelError, r"\.c", lambda: write_c(designed()[1], tmp_path / "a.txt")),
        (ModelError, "sampled controller", lambda: write_c(designed(False)[1], path)),
        (AssumptionError, "recovery", lambda: write_c(slow, path, limits=1.0)),
        (AssumptionError, "same sample", lambda: write_c(reads, path)),
        (LabelError, "with a limit", lambda: write_c(pi_controller(), path, limits={"g": 1.0})),
        (ModelError, "low < high", lambda: write_c(pi_controller(), path, limits=(2.0, 1.0))),
        (ModelError, "by place", lambda: write_c(slow, path, schedule="s")),
        (ModelError, "two places", lambda: write_c({0.0: slow}, path, schedule="s")),
    ):
        with pytest.raises(error, match=cause):
            call()


def test_a_wrong_block_is_found(monkeypatch, tmp_path):
    """The certificate compares responses: what drives the states off by 1e-6 is refused."""
    from flexplant.synthesis.aftercare import forms as two_state

    right = two_state._arranged

    def wrong(*args, **options):
        form = right(*args, **options)
        return form._replace(B=(1 + 1e-6) * form.B)

    monkeypatch.setattr(two_state, "_arranged", wrong)
    with pytest.raises(CertificateError, match="differ from the system"):
        write_c(designed()[1], tmp_path / "a.c")


@pytest.mark.parametrize("seed", range(4))
def test_a_channel_of_rounding_is_no_obstacle(seed):
    """Two laws that do not see each other, in mixed states: what couples them is rounding."""
    rng, dt, channels = np.random.default_rng(seed), 1e-4, [0] * 6 + [1] * 6
    omega, zeta = 2 * np.pi * 10 ** rng.uniform(-1, 3, 12), 10 ** rng.uniform(-2, 0, 12)
    pairs = [[[0.0, w], [-w, -2 * z * w]] for w, z in zip(omega, zeta, strict=True)]
    A, own = la.expm(dt * la.block_diag(*pairs)), np.eye(2)[np.repeat(channels, 2)]
    B, C = own * rng.standard_normal((24, 2)), 1e8 * own.T * rng.standard_normal((2, 24))
    Q, d = la.qr(rng.standard_normal((24, 24)))[0], 10 ** rng.uniform(-3, 3, 24)
    mixed = StateSpace(
        Q @ A @ Q.T * d / d[:, None], Q @ B / d[:, None], C @ Q.T * d, np.zeros((2, 2)), dt
    )
    form, freq = two_state_form(mixed), np.geomspace(1.0, 4e3, 50)
    z = np.exp(2j * np.pi * freq * dt)
    exact = C @ np.linalg.solve(z[:, None, None] * np.eye(24) - A, B)
    gap = np.abs(form.response(freq, dt) - exact.transpose(1, 2, 0)).max(axis=2)
    assert gap.max() < 1e-8 * np.abs(exact).max(axis=0).diagonal().min()


@pytest.mark.slow
@compiles
@pytest.mark.parametrize("single", [False, True])
def test_a_filter_in_c_does_not_drift(tmp_path, single):
    """Its state is one that it had before, to the bit: so it will be after any number of periods.

    Rounding may alternate between neighbours in the last bit; more than a few are drift.
    """
    law = fx.design_kalman(fx.testbeds.three_masses()).system
    rng, period = np.random.default_rng(0), 50
    records = rng.standard_normal((period, len(law.inputs))) * [
        1e-6 if name.startswith("y") else 1.0 for name in law.inputs
    ]
    code = Compiled(tmp_path, law, single=single)
    states = []
    for _ in range(300):
        out = [code(sample) for sample in records]
        states.append(bytes(code.state))
    assert states[-1] in states[-9:-1]
    exact = periodic_answer(law, records)
    scale = np.abs(exact).max(axis=0)
    assert np.abs((np.array(out) - exact) / scale).max() < (1e-5 if single else 1e-11)
