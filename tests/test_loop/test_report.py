"""Loop-by-loop margins and the Nyquist count, against closed forms and polynomial roots."""

import warnings

import numpy as np
import pytest
import scipy.linalg as la

import flexplant as fx
from flexplant.errors import AssumptionError, ModelError
from flexplant.loop import in_axes, report_loops
from flexplant.loop.broken import peaking_size, scaled_size
from flexplant.loop.report import loop_margins
from flexplant.lti import Frf, StateSpace, append, discretized, frequency_response
from flexplant.lti.interconnection import loop_poles
from flexplant.plant import assemble_plant, gravity_axes
from stages import RATE, ports, reduced

LINES = np.arange(0.5, 400.0, 0.05)


def of(num, den, **names):
    """A transfer function as a system, in controllable form."""
    den = np.asarray(den, dtype=float)
    num = np.concatenate([np.zeros(den.size - len(num)), num]) / den[0]
    den = den / den[0]
    n = den.size - 1
    A = np.vstack([-den[1:], np.eye(n)[:-1]])
    C = num[1:] - num[0] * den[1:]
    return StateSpace(A, np.eye(n)[:, :1], [C], [[num[0]]], **names)


def test_margins_in_closed_form():
    """L = 2 / (s (s + 1) (s + 2)): gain margin 3 at sqrt(2) rad/s; S by a fine sweep."""
    G = of([1.0], [1.0, 3.0, 2.0, 0.0], inputs=["u"], outputs=["y"])
    report = report_loops((G, StateSpace([], [], [], [[-2.0]], inputs=["y"], outputs=["u"])))
    loop = report["u"]
    assert report.is_stable
    assert loop.gain_margin == pytest.approx(3.0, rel=1e-9)
    assert loop.gain_reduction == 0.0
    omega = np.roots([1.0, 0.0, 5.0, 0.0, 4.0, 0.0, -4.0])  # |L| = 1
    omega = float(omega[(abs(omega.imag) < 1e-9) & (omega.real > 0)][0].real)
    assert loop.crossovers == pytest.approx([omega / (2 * np.pi)], rel=1e-9)
    phase = 180 - 90 - np.degrees(np.arctan(omega) + np.arctan(omega / 2))
    assert loop.phase_margin == pytest.approx(phase, rel=1e-9)
    s = 1j * np.geomspace(0.1, 10.0, 20000)
    least = np.abs(1 + 2.0 / (s * (s + 1) * (s + 2))).min()
    assert loop.modulus_margin == pytest.approx(least, rel=1e-6)
    assert "phase margin 33 deg" in repr(report)


@pytest.mark.parametrize("count", [12, 300])
def test_many_crossings_take_no_more_responses_than_few(count):
    """(1 + sin(2 pi f) / 2) exp(-7 i f) crosses 1 at each k / 2, the real axis at k pi / 7 Hz."""
    freq, calls = np.linspace(0.2, 0.7 + 0.5 * count, 40 * count), []

    def L(f):
        calls.append(f)
        return (1.0 + 0.5 * np.sin(2 * np.pi * f)) * np.exp(-7j * f)

    found = loop_margins("u", freq, L(freq), L)
    assert len(calls) < 60
    np.testing.assert_allclose(found.crossovers, 0.5 * np.arange(1, count + 2), rtol=1e-9)
    phases = np.abs(np.angle(L(0.5 * np.arange(1, count + 2)), deg=True))
    assert found.phase_margin == pytest.approx(phases.min(), abs=1e-6)
    real = L(np.arange(1, int(freq[-1] * 7 / np.pi) + 1) * np.pi / 7).real
    assert found.gain_margin == pytest.approx(1 / real[(real > 0) & (real < 1)].max(), rel=1e-9)
    assert found.gain_reduction == pytest.approx(1 / real[real > 1].min(), rel=1e-9)


def test_an_unstable_plant_may_lose_gain_too():
    """1 / (s - 1) with gain 4 (and a lag at 20 rad/s): it may fall to a quarter."""
    G = of([20.0], np.polymul([1.0, -1.0], [1.0, 20.0]), inputs=["u"], outputs=["y"])
    K = StateSpace([], [], [], [[-4.0]], inputs=["y"], outputs=["u"])
    frf = frequency_response(G, np.geomspace(1e-3, 100.0, 2000))
    for plant in (G, frf):
        report = report_loops((plant, K), unstable=1)
        assert report.is_stable
        assert report["u"].gain_reduction == pytest.approx(0.25, rel=1e-2)
    assert report_loops((frf, K.replace(D=[[-0.5]])), unstable=1).unstable == 1
    assert report_loops((frf, K.replace(D=[[4.0]])), unstable=1).unstable == 1


def machine(rng, springs):
    """A mass with three modes, free or on springs (negative: magnets): numerator, denominator."""
    body = [1.0, 0.02 * np.sqrt(abs(springs)), springs]
    parts = [(1.0, body)]
    for freq in rng.uniform(20.0, 200.0, 3):
        omega = 2 * np.pi * freq
        parts.append((rng.choice([1.0, -0.5]), [1.0, 0.01 * omega, omega**2]))
    den = np.array([1.0])
    for _, factor in parts:
        den = np.polymul(den, factor)
    num = np.zeros(1)
    for i, (gain, _) in enumerate(parts):
        rest = np.array([gain])
        for j, (_, factor) in enumerate(parts):
            rest = rest if i == j else np.polymul(rest, factor)
        num = np.polyadd(num, rest)
    return num, den


@pytest.mark.slow
def test_the_margin_of_all_loops_is_that_of_the_side_where_they_are_broken():
    """Two first-order loops, one coupled 20 times into the other: far apart at u and at y."""
    G = StateSpace(-0.01 * np.eye(2), np.eye(2), [[1.0, 20.0], [0.0, 1.0]], np.zeros((2, 2)),
                   inputs=["a", "b"], outputs=["p", "q"])  # fmt: skip
    K = StateSpace([], [], [], -np.diag([1.0, 0.1]), inputs=["p", "q"], outputs=["a", "b"])
    freq = np.geomspace(1e-4, 10.0, 4001)
    response = frequency_response(G, freq)
    P = np.moveaxis(response.data, 2, 0)
    found = {}
    for at, L in (("u", K.D @ P), ("y", P @ K.D)):
        wanted = 1.0 / np.linalg.norm(np.linalg.inv(np.eye(2) - L), 2, axis=(1, 2)).max()
        for plant in (G, response):
            found[at] = report_loops((plant, K), at=at).modulus_margin
            assert found[at] == pytest.approx(wanted, rel=1e-5)
    assert found["y"] > 8.0 * found["u"]


@pytest.mark.slow
@pytest.mark.parametrize("springs", [0.0, (2 * np.pi * 2.0) ** 2, -((2 * np.pi * 2.0) ** 2)])
def test_the_count_is_that_of_the_characteristic_polynomial(springs):
    """PID of many gains on machines with light modes; unstable ones among them."""
    rng = np.random.default_rng(3)
    seen = set()
    for _ in range(12):
        num, den = machine(rng, springs)
        freq = rng.uniform(5.0, 60.0)
        omega = 2 * np.pi * freq
        a = omega / 3
        top = omega**2 / 3 * np.polymul([1.0, 0.1 * omega], [1 / a, 1.0])
        bottom = np.polymul([1.0, 0.0], [1 / (3 * omega), 1.0])
        K = of(-top, bottom, inputs=["y"], outputs=["u"])
        s = 2j * np.pi * LINES
        data = np.polyval(num, s) / np.polyval(den, s)
        frf = Frf(LINES, data[None, None], ["u"], ["y"])
        roots = np.roots(np.polyadd(np.polymul(top, num), np.polymul(bottom, den)))
        wanted = int(np.count_nonzero(roots.real > 0))
        states = {"rigid": int(springs == 0), "unstable": int(springs < 0)}
        report = report_loops((frf, K), **states)
        assert report.unstable == wanted, report.reason
        assert (report.modulus_margin == 0.0) == (wanted > 0)
        seen.add(wanted > 0)
    assert seen == {True, False}


@pytest.mark.slow
@pytest.mark.parametrize("axes", [2, 3])
@pytest.mark.parametrize("measured", [False, True])
def test_units_of_an_axis_change_no_margin_of_loops_of_several_units(axes, measured):
    """Coupled bodies, one axis in m and one in rad, the latter in other units too."""
    rng = np.random.default_rng(5)
    M = np.eye(axes) + 0.3 * rng.standard_normal((axes, axes))
    A = np.kron(np.eye(axes), [[0.0, 1.0], [0.0, 0.0]])
    B, C = np.zeros((2 * axes, axes)), np.zeros((axes, 2 * axes))
    B[1::2], C[:, ::2] = np.linalg.inv(M @ M.T), np.eye(axes)
    law = -(fx.Pid.corners(400.0, zero=2.0, pole=40.0)).system
    K = append(*[law.replace(inputs=[f"y{i}"], outputs=[f"u{i}"]) for i in range(axes)])
    found = {}
    for size in (1.0, 1e-6):
        T = np.diag([size, *np.ones(axes - 1)])
        G = StateSpace(A, B @ T, np.linalg.inv(T) @ C, np.zeros((axes, axes)),
                       inputs=K.outputs, outputs=K.inputs)  # fmt: skip
        for units in ({}, {"y0": "rad", "y1": "m", "y2": "m"}):
            plant = G.replace(
                units={name: unit for name, unit in units.items() if name in G.outputs}
            )
            if measured:
                plant = frequency_response(plant, np.geomspace(0.1, 100.0, 400))
            report = report_loops((plant, K), at="y", rigid=axes * measured)
            found[size, bool(units)] = report
            assert ("axes scaled (units: rad, m)" in repr(report)) == bool(units)
            assert report.scaled_margin <= min(one.modulus_margin for one in report.values()) + 1e-9
    one, other = found[1.0, True], found[1e-6, True]
    assert other.modulus_margin == pytest.approx(one.modulus_margin, rel=1e-6)
    assert one.modulus_margin == one.scaled_margin
    assert found[1e-6, False].scaled_margin == pytest.approx(one.scaled_margin, rel=1e-6)
    assert found[1.0, False].modulus_margin <= one.scaled_margin * (1 + 1e-9)
    assert found[1e-6, False].modulus_margin < 1e-3  # what mixed units made of it


@pytest.mark.slow
def test_the_scaling_of_axes_is_optimal():
    """Against a search over D: within the 2 % of the power of singular values that is minimised."""
    rng = np.random.default_rng(0)
    S = np.eye(3) + rng.standard_normal((8, 3, 3)) + 1j * rng.standard_normal((8, 3, 3))
    grid = np.linspace(-2.0, 2.0, 81)
    logs = np.stack(np.broadcast_arrays(0.0, grid[:, None], grid), axis=-1).reshape(-1, 3)
    for one in S:
        scaled = one * np.exp(logs[:, :, None] - logs[:, None])
        least = np.linalg.norm(scaled, 2, axis=(1, 2)).min()
        assert 0.98 * least < scaled_size(one[None])[0] < 1.025 * least


@pytest.mark.slow
@pytest.mark.parametrize("n", [2, 4])
def test_the_largest_scaled_size_is_found_by_its_bounds(n):
    """Against all points: coupled, nearly decoupled, one-way and mixed units; elsewhere below."""
    rng = np.random.default_rng(n)
    for coupling in (0.0, 1e-9, 1e-3, 1.0):
        off = rng.standard_normal((20, n, n)) + 1j * rng.standard_normal((20, n, n))
        own = rng.uniform(0.5, 2.0, (20, n)) * np.exp(1j * rng.uniform(-3.0, 3.0, (20, n)))
        S = coupling * off + own[:, None] * np.eye(n)
        S[::4] = np.triu(S[::4])
        units = 10.0 ** rng.uniform(-1.5, 1.5, n)
        every, found = scaled_size(S), peaking_size(units[:, None] * S / units)
        assert found.max() == pytest.approx(every.max(), rel=1e-6)
        assert peaking_size(S).max() == pytest.approx(every.max(), rel=1e-12)
        assert peaking_size(S).argmax() == every.argmax()
        assert np.all(found <= every * (1.0 + 1e-6))


@pytest.mark.parametrize("n", [2, 3, 6])
def test_what_acts_one_way_is_scaled_away(n):
    """Triangular S, loops in any order, couplings from 1e-6 to 1e6: the diagonal is left."""
    rng = np.random.default_rng(n)
    S = np.triu(10.0 ** rng.uniform(-6.0, 6.0, (20, n, n)) * np.exp(2j * rng.random((20, n, n))))
    S[:, range(n), range(n)] = rng.uniform(0.5, 2.0, (20, n))
    order = rng.permutation(n)
    S = S[:, order][:, :, order]
    with np.errstate(over="raise", invalid="raise", divide="raise"):
        found = scaled_size(S)
    assert found.max() == pytest.approx(np.abs(np.einsum("fii->fi", S)).max(), rel=1e-3)


def body_with_modes(rng, axes):
    """Free bodies and lightly damped modes of any sign on them, PID with roll-off; coarse lines."""
    count, spacing = rng.integers(1, 4), rng.choice([0.1, 0.25, 0.5, 1.0, 2.0])
    freq, zeta = rng.uniform(15.0, 300.0, count), 10.0 ** rng.uniform(-4.0, -1.5, count)
    size = np.sqrt(10.0 ** rng.uniform(-2.0, 0.0, count))[:, None]
    omega = 2 * np.pi * freq
    pairs = [[[0, 1], [-(w**2), -2 * z * w]] for w, z in zip(omega, zeta, strict=True)]
    A = la.block_diag(*[[[0, 1], [0, 0]]] * axes, *pairs)
    B, C = np.zeros((len(A), axes)), np.zeros((axes, len(A)))
    shapes = rng.standard_normal((2, count, axes)) * size
    B[1::2] = np.vstack([np.eye(axes), shapes[0]])
    C[:, ::2] = np.hstack([np.eye(axes), shapes[rng.integers(2)].T])
    G = StateSpace(A, B, C, np.zeros((axes, axes)))
    laws = []
    for one in 10.0 ** rng.uniform(0.7, 1.7) * rng.uniform(0.7, 1.3, axes):
        pid = fx.Pid.corners(
            (2 * np.pi * one) ** 2 / 3, integrator=one / 10, zero=one / 3, pole=3 * one
        )
        laws.append((pid * fx.LowPass(10 * one)).system)
    parts = [la.block_diag(*[getattr(law, name) for law in laws]) for name in "ABCD"]
    K = StateSpace(parts[0], parts[1], -parts[2], -parts[3], inputs=G.outputs, outputs=G.inputs)
    lines = np.arange(max(1.0, spacing), 420.0, spacing) + rng.uniform(0.0, spacing)
    return G, K, lines, 2.0 * zeta * freq


@pytest.mark.slow
@pytest.mark.parametrize("noise", [0.0, 1e-3])
@pytest.mark.parametrize("axes", [1, 2])
def test_stable_on_coarse_lines_is_stable_or_says_of_which_modes_it_is_not(axes, noise):
    """Of loops on lines that step over resonances: exact poles decide."""
    rng, seen = np.random.default_rng(axes), {}
    for _ in range(24):
        G, K, lines, widths = body_with_modes(rng, axes)
        frf = frequency_response(G, lines)
        error = rng.standard_normal((2, *frf.data.shape))
        frf = frf.replace(data=frf.data * (1.0 + noise * (error[0] + 1j * error[1])))
        report = report_loops((frf, K), rigid=axes)
        truly = bool(np.any(loop_poles(G, K).real > 0.0))
        said = "open" if report.is_stable is None else "unstable"
        if report.is_stable:
            said = "if" if report.narrowest else "stable"
            assert not truly or np.any(widths < report.narrowest)
            assert ("unless a mode between the lines near" in repr(report)) == (said == "if")
        assert truly or said != "unstable"
        seen[said] = seen.get(said, 0) + 1
    assert seen["unstable"] > 3
    assert seen["stable" if not noise else "if"] > 7
    assert seen.get("open", 0) < 5


def test_what_cannot_be_judged_says_why():
    num, den = machine(np.random.default_rng(1), 0.0)
    top = (2 * np.pi * 20.0) ** 2 / 3 * np.array([1 / 40.0, 1.0])
    K = of(-top, [1e-3, 1.0], inputs=["y"], outputs=["u"])

    def judged(freq, **states):
        s = 2j * np.pi * freq
        frf = Frf(freq, (np.polyval(num, s) / np.polyval(den, s))[None, None], ["u"], ["y"])
        return report_loops((frf, K), **states)

    assert judged(LINES, rigid=1).is_stable is not None
    stated_wrong = judged(LINES, rigid=0)
    assert stated_wrong.is_stable is None
    assert "slope 2, but rigid=0 was stated" in stated_wrong.reason
    coarse = judged(np.arange(1.0, 400.0, 20.0), rigid=1)
    assert coarse.is_stable is None
    assert "finer resolution" in coarse.reason
    short = judged(LINES[LINES < 15.0], rigid=1)
    assert "measure at higher frequencies" in short.reason


@pytest.mark.slow
def test_each_loop_is_broken_with_the_others_closed():
    """Two coupled masses: L_1 with loop 2 closed, by hand."""
    M = np.array([[2.0, 0.7], [0.7, 1.0]])
    G = StateSpace(
        np.block([[np.zeros((2, 2)), np.eye(2)], [np.zeros((2, 4))]]),
        np.vstack([np.zeros((2, 2)), np.linalg.inv(M)]),
        np.eye(2, 4),
        np.zeros((2, 2)),
        inputs=["a", "b"],
        outputs=["ya", "yb"],
    )
    law = fx.Pid.corners(400.0, zero=2.0, pole=40.0)
    one = -law.system
    K = append(
        one.replace(inputs=["ya"], outputs=["a"], states=["k1"]),
        (2.0 * one).replace(inputs=["yb"], outputs=["b"], states=["k2"]),
    )
    freq = np.geomspace(0.1, 100.0, 4000)
    s = 2j * np.pi * freq
    k = law.law.response(freq)
    P = np.linalg.inv(M)[:, :, None] / s**2
    other = P[0, 0] - P[0, 1] * P[1, 0] * 2 * k / (1 + 2 * k * P[1, 1])
    wanted = np.abs(1 + k * other).min()
    for plant, states in ((G, {}), (frequency_response(G, freq), {"rigid": 2})):
        report = report_loops((plant, K), **states)
        assert report.is_stable
        assert report["a"].modulus_margin == pytest.approx(wanted, rel=2e-3)
        assert report.modulus_margin <= report["a"].modulus_margin * (1 + 1e-9)
        at_y = report_loops((plant, K), at="y", **states)
        assert list(at_y) == ["ya", "yb"]


def test_a_measured_plant_in_axes_with_hold_and_delay():
    """The Frf of the continuous stage beside the discretised one, below its aliases."""
    continuous = assemble_plant(reduced(), ports(references=[]))
    axes = gravity_axes(continuous)
    freq = np.arange(5.0, 300.0, 5.0)
    frf = frequency_response(continuous.Gyu, freq)
    found = in_axes(frf, before=axes.accelerations, after=axes.to_motions, rate=RATE, delay=1.5)
    sampled = frequency_response(discretized(continuous.Gyu, RATE, delay=1.5), freq).data
    wanted = np.einsum("ay,yuf,ub->abf", axes.T_y, sampled, axes.T_u @ axes.mass)
    size = np.abs(wanted[0, 0])
    assert np.max(np.abs(found.data - wanted) / size) < 2e-2
    assert np.max(np.abs(found.data[0, 0] / wanted[0, 0] - 1)) < 3e-3
    rigid = -np.exp(-4j * np.pi * freq[:3] / RATE) / (2 * np.pi * freq[:3]) ** 2
    assert np.max(np.abs(found.data[0, 0, :3] / rigid - 1)) < 2e-3
    assert (found.inputs, found.outputs) == (axes.accelerations.inputs, axes.to_motions.outputs)
    held = in_axes(frf, before=np.eye(4)[:, :2], rate=RATE, hold=False)
    np.testing.assert_allclose(held.data, frf.data[:, :2], rtol=1e-12)


@pytest.mark.filterwarnings("ignore:.*half the sampling rate")
def test_lines_above_half_the_rate_are_seen_below():
    """A mode at 300 Hz, sampled at 450 Hz: in its samples it is one at 150 Hz."""
    w = 2 * np.pi * 300.0
    A = np.array([[0, 1.0, 0, 0], [0, 0, 0, 0], [0, 0, 0, 1], [0, 0, -(w**2), -2e-3 * w]])
    G = StateSpace(A, [[0], [0.1], [0], [0.1]], [[1, 0, 0.5, 0]], [[0.0]])
    frf = frequency_response(G, np.arange(2.0, 2000.0, 0.05))
    found = in_axes(frf, rate=450.0, delay=0.5)
    wanted = frequency_response(discretized(G, 450.0, delay=0.5), found.freq).data[0, 0]
    near = (found.freq > 140.0) & (found.freq < 160.0)
    size = np.abs(wanted[near]).max()
    assert size > 20 * np.abs(wanted[found.freq > 160.0][200])
    assert np.max(np.abs(found.data[0, 0] - wanted)[near]) < 1e-2 * size
    with pytest.raises(ModelError, match=r"all lines, from 2 Hz, lie above half the rate, 1.5 Hz"):
        in_axes(frf, rate=3.0)


def crossings_of_poles(G, K, factors):
    """The gain factors at which the number of unstable poles of the loop changes, by bisection."""
    g, k, dt = G.system if hasattr(G, "system") else G, K, G.dt

    def unstable(factor):
        poles = la.eigvals(np.block([
            [g.A + g.B @ (factor * k.D) @ g.C, g.B @ (factor * k.C)], [k.B @ g.C, k.A],
        ]))  # fmt: skip
        return int(np.sum(np.abs(poles) > 1 if dt else poles.real > 0))

    counts = [unstable(f) for f in factors]
    found = []
    for i in np.flatnonzero(np.diff(counts)):
        low, high = factors[i], factors[i + 1]
        for _ in range(60):
            middle = np.sqrt(low * high)
            low, high = (middle, high) if unstable(middle) == counts[i] else (low, middle)
        found.append(low)
    return np.array(found)


@pytest.mark.slow
@pytest.mark.parametrize("sampled", [False, True])
@pytest.mark.parametrize("kind", ["undamped", "light", "integrator", "lags"])
def test_gain_margins_are_the_factors_at_which_poles_cross(kind, sampled):
    """PI controllers: also where an undamped pole takes the loop gain through infinity."""
    for seed in range(4):
        rng = np.random.default_rng(seed)
        w = 10 ** rng.uniform(0, 1)
        den = {
            "undamped": [1 / w**2, 0.0, 1.0], "light": [1 / w**2, 2e-3 / w, 1.0],
            "integrator": [1 / w**2, 1 / w, 0.0], "lags": [1 / w**2, 2.2 / w, 1.0],
        }[kind]  # fmt: skip
        G = of([1.0], den, inputs=["u"], outputs=["y"])
        gain, time = 10 ** rng.uniform(-1, 0.5), 10 ** rng.uniform(0.5, 1.5) / w
        K = StateSpace([[0.0]], [[1.0]], [[-gain / time]], [[-gain]], inputs=["y"], outputs=["u"])
        if sampled:
            rate = w * 10 ** rng.uniform(0.5, 1.5)
            G, K = discretized(G, rate), fx.lti.tustin(K, rate)
        one = report_loops((G, K))["u"]
        below = crossings_of_poles(G, K, np.geomspace(1e-6, 1.0, 400))
        above = crossings_of_poles(G, K, np.geomspace(1.0, 1e4, 400))
        if below.size:
            assert one.gain_reduction == pytest.approx(below.max(), rel=1e-4), seed
        else:
            assert one.gain_reduction == 0.0, seed
        if above.size:
            assert one.gain_margin == pytest.approx(above.min(), rel=1e-4), seed
        else:
            assert one.gain_margin > 1e4, seed


def measured_machine(rng):
    """Free and flexible modes on sampled channels, delayed; PD control of each channel."""
    n = int(rng.integers(1, 4))
    free, rate = int(rng.integers(0, n + 1)), 1000.0
    w = np.concatenate([np.zeros(free), 2 * np.pi * rng.uniform(5, 40, rng.integers(1, 3))])
    A = la.block_diag(*([[0, 1], [-x * x, -2 * rng.uniform(0.01, 0.05) * x]] for x in w))
    phi = 0.5 * rng.standard_normal((n, w.size))
    phi[:, :free] = la.qr(rng.standard_normal((n, n)))[0][:, :free]
    B, C = np.zeros((2 * w.size, n)), np.zeros((n, 2 * w.size))
    B[1::2], C[:, ::2] = phi.T * rng.choice([-1.0, 1.0], w.size, p=[0.4, 0.6])[:, None], phi
    B[1 : 2 * free : 2] = phi[:, :free].T
    names = {"inputs": [f"u{i}" for i in range(n)], "outputs": [f"y{i}" for i in range(n)]}
    G = discretized(StateSpace(A, B, C, np.zeros((n, n)), **names), rate, delay=1.0)
    cross = 2 * np.pi * 10 ** rng.uniform(0.0, 1.2)
    law = fx.lti.tustin(fx.lti.tf([-3 * cross, -(cross**2)], [1 / (8 * cross), 1.0]), rate)
    laws = [law.replace(inputs=[f"y{i}"], outputs=[f"u{i}"], states=[f"s{i}"]) for i in range(n)]
    K = append(*laws)
    closed = np.block([[G.A + G.B @ K.D @ G.C, G.B @ K.C], [K.B @ G.C, K.A]])
    return G, K, int(np.sum(np.abs(la.eigvals(closed)) > 1))


@pytest.mark.slow
@pytest.mark.parametrize("zero", [False, True])
def test_the_modulus_margin_of_a_measured_loop_is_that_of_a_stable_one(zero):
    """Poles of the model say which; an Frf that begins at 0 Hz is read from its next line on."""
    lines = np.arange(0.05, 500.0, 0.05)
    seen = {"stable": 0, "unstable": 0, "open": 0}
    for seed in range(0, 60, 4):
        G, K, unstable = measured_machine(np.random.default_rng(seed + zero))
        freq, data = lines, frequency_response(G, lines).data
        if zero:
            freq, data = np.append(0.0, lines), np.concatenate([0 * data[..., :1], data], axis=2)
        pair = Frf(freq, data, inputs=G.inputs, outputs=G.outputs), K
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            try:
                margin = fx.modulus_margin(pair)
            except AssumptionError as error:
                assert "not known whether the closed loop is stable" in str(error)
                seen["open"] += 1
                continue
            of_model = fx.modulus_margin((G, K))
        said = [str(one.message) for one in caught if "no modulus margin" in str(one.message)]
        seen["unstable" if unstable else "stable"] += 1
        assert len(said) == (2 if unstable else 0)  # of the lines and of the model
        assert margin == (0.0 if unstable else pytest.approx(of_model, rel=0.1)), seed
        assert not unstable or f"{unstable} pole" in said[0]
    assert seen["stable"] > 5
    assert seen["unstable"] >= 1
    assert seen["open"] <= 3


def test_a_loop_that_is_not_judged_has_no_margin_alone():
    frf = Frf([1.0, 2.0], [[[1.0, 0.5]]], inputs=["u"], outputs=["y"])
    K = StateSpace([], [], [], [[-1.0]], inputs=["y"], outputs=["u"])
    with pytest.raises(AssumptionError, match=r"2 lines are too few.*report_loops\("):
        fx.modulus_margin((frf, K))
    assert "stability not judged, modulus margin" in repr(report_loops((frf, K)))
    with pytest.raises(ModelError, match="no line above 0 Hz"):
        fx.modulus_margin((Frf([0.0], [[[1.0]]], inputs=["u"], outputs=["y"]), K))


def test_rounding_next_to_half_the_rate_is_no_second_gain_margin():
    """The table of margins had the crossing at 2000 Hz twice."""
    freq = np.geomspace(1.0, 2000.0, 400)

    def gain(f):
        return np.asarray(1e-3 + 1e-16j * (f - 2000.0 * (1 - 1e-9)))

    found = loop_margins("u", freq, gain(freq), gain, sampled=True)
    assert sum(place > 1999.0 for place, _ in found.gains) == 1
