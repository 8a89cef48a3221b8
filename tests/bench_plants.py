"""Plants for the workbench: a mass with a mode of 0.1 %, measured and as a model; coupled axes."""

import ctypes
import subprocess
import zipfile

import numpy as np

import flexplant as fx
from flexplant.synthesis import LoopDesign, LowPass, Pid, ShapedAxis

RATE = 4e3
MODE = 300.0  # Hz; a loop with gain there is unstable, for the delay


def light(mode=MODE, damping=1e-3, residue=0.1, rate=RATE):
    """Return the sampled plant: a mass of 1 kg and a lightly damped mode."""
    w = 2.0 * np.pi * mode
    body = fx.lti.tf([1.0], [1.0, 0.0, 0.0])
    swing = fx.lti.tf([residue], [1.0, 2.0 * damping * w, w * w])
    plant = fx.lti.parallel(body, swing).replace(inputs=["u1"], outputs=["y1"])
    return fx.lti.discretized(plant, rate, delay=1)


def lines(count=2000, last=500.0):
    return np.linspace(last / count, last, count)


def measured(plant, freq=None, deviation=0.0):
    """Return the lines of a plant as a measurement shows them."""
    freq = lines() if freq is None else freq
    frf = fx.frequency_response(plant, freq)
    if not deviation:
        return frf
    rng = np.random.default_rng(3)
    size = deviation * np.abs(frf.data)
    noise = rng.normal(size=(2, *frf.data.shape)) / np.sqrt(2.0)
    return frf.replace(
        data=frf.data + size * (noise[0] + 1j * noise[1]), variance=size**2, quantity=None
    )


def law(crossover=40.0, *more):
    """Return an axis of PID and low-pass that crosses 1 where the mass alone does."""
    pid = Pid.corners(1.0, integrator=crossover / 8, zero=crossover / 3, pole=3 * crossover)
    gain = (2.0 * np.pi * crossover) ** 2 / 3.0
    return ShapedAxis([pid, LowPass(8 * crossover), *more], gain)


def coupled(axes=2, modes=3, count=2000, last=1000.0, rate=RATE, seed=0):
    """Return measured axes that modes couple."""
    rng = np.random.default_rng(seed)
    freq = np.linspace(last / count, last, count)
    z = np.exp(2j * np.pi * freq / rate)
    s = 2j * np.pi * freq
    G = np.zeros((axes, axes, count), dtype=complex)
    G[range(axes), range(axes)] = 1.0 / s**2
    for f in np.linspace(0.2, 0.7, modes) * last:
        w, b = 2.0 * np.pi * f, 0.25 * rng.normal(size=axes)
        G += np.einsum("i,j,f->ijf", b, b, 1.0 / (s**2 + 0.02 * w * s + w * w))
    return fx.Frf(freq, G * z**-1.5)


def design(plant, axis=None, **options):
    """Return a design with the same law in all axes."""
    names = LoopDesign.on(plant, **options).axes
    return LoopDesign.on(plant, dict.fromkeys(names, axis or law()), **options)


def closed_poles(P, K):
    """The poles of ``u = K y``, from the matrices alone."""
    eye = np.eye(len(P.C))
    assert not np.any(P.D)
    A = np.block([[P.A + P.B @ K.D @ P.C, P.B @ K.C], [K.B @ eye @ P.C, K.A]])
    return np.linalg.eigvals(A)


def by_matrices(K, error):
    """The commands of a controller for its first input, by its matrices alone."""
    x, found = np.zeros(K.n_states), []
    for e in error:
        found.append((K.C @ x + K.D[:, 0] * e)[0])
        x = K.A @ x + K.B[:, 0] * e
    return np.array(found)


def by_c(archive, folder, error):
    """The same by the C files of an archive, compiled."""
    with zipfile.ZipFile(archive) as files:
        assert sorted(files.namelist()) == ["loops.c", "loops.h"]
        files.extractall(folder)
    library = folder / "loops.so"
    words = ["cc", "-std=c99", "-O1", "-shared", "-fPIC", "-o", library, folder / "loops.c"]
    subprocess.run(words, check=True, timeout=60)
    code, state = ctypes.CDLL(str(library)), ctypes.create_string_buffer(1 << 16)
    value, out, found = ctypes.c_double(), ctypes.c_double(), []
    code.loops_reset(state)
    for e in error:
        value.value = e
        code.loops_step(state, ctypes.byref(value), ctypes.byref(out))
        found.append(out.value)
    return np.array(found)
