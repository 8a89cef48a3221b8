"""Frequency responses out of plain arrays: every axis where it belongs, or a question."""

import numpy as np
import pytest
import scipy.io

from flexplant.errors import FlexplantError, LabelError, ModelError, ShapeError
from flexplant.io import read_frf_mat, read_frf_npz
from flexplant.lti import Frf

FREQ = np.array([1.0, 2.0, 5.0, 9.0])
RNG = np.random.default_rng(0)
DATA = RNG.normal(size=(3, 2, 4)) + 1j * RNG.normal(size=(3, 2, 4))
NAMES = {"outputs": ["41:z", "2:rx", "7:x"], "inputs": ["u1", "u2"]}


def cells(names):
    array = np.empty((len(names), 1), dtype=object)
    array[:, 0] = names
    return array


def save(tmp_path, kind, **content):
    path = tmp_path / f"a.{kind}"
    if kind == "npz":
        np.savez(path, **content)
    else:
        content = {k: cells(v) if k in NAMES else v for k, v in content.items()}
        scipy.io.savemat(path, content)
    return path


READERS = {"npz": read_frf_npz, "mat": read_frf_mat}
KINDS = pytest.mark.parametrize("kind", ["npz", "mat"])


@pytest.mark.slow
@KINDS
def test_everything_the_file_holds(tmp_path, kind):
    coherence, variance = RNG.uniform(size=DATA.shape), RNG.uniform(size=DATA.shape)
    path = save(
        tmp_path,
        kind,
        freq=FREQ,
        data=DATA,
        quantity="velocity",
        coherence=coherence,
        variance=variance,
        **NAMES,
    )
    frf = READERS[kind](path)
    assert np.array_equal(frf.data, DATA)
    assert np.array_equal(frf.freq, FREQ)
    assert frf.outputs == tuple(NAMES["outputs"])
    assert frf.inputs == tuple(NAMES["inputs"])
    assert np.array_equal(frf.coherence, coherence)
    assert np.array_equal(frf.variance, variance)
    assert frf.quantity == "velocity"
    assert frf.converted("displacement").data == pytest.approx(DATA / (2j * np.pi * FREQ))
    with pytest.raises(ModelError, match="says it holds velocity"):
        READERS[kind](path, quantity="displacement")


@pytest.mark.slow
@KINDS
@pytest.mark.parametrize("axis", [0, 1, 2])
def test_the_axis_of_frequency_is_found(tmp_path, kind, axis):
    path = save(tmp_path, kind, f=FREQ, H=np.moveaxis(DATA, 2, axis))
    frf = READERS[kind](path, freq="f", data="H", quantity="acceleration")
    assert np.array_equal(frf.data, DATA)
    assert frf.quantity == "acceleration"
    assert READERS[kind](path, freq="f", data="H").quantity is None


@KINDS
def test_an_axis_of_the_same_length_is_asked_for(tmp_path, kind):
    square = RNG.normal(size=(4, 2, 4))
    path = save(tmp_path, kind, freq=FREQ, data=square)
    with pytest.raises(ShapeError, match=r"axes \[0, 2\].*frequency_axis"):
        READERS[kind](path)
    assert np.array_equal(READERS[kind](path, frequency_axis=2).data, square)
    assert np.array_equal(READERS[kind](path, frequency_axis=0).data, np.moveaxis(square, 0, 2))
    with pytest.raises(ShapeError, match="axis 1"):
        READERS[kind](path, frequency_axis=1)


@KINDS
def test_a_single_pair(tmp_path, kind):
    frf = READERS[kind](save(tmp_path, kind, freq=FREQ, data=DATA[0, 0]))
    assert frf.data.shape == (1, 1, 4)
    assert np.array_equal(frf["y1", "u1"], DATA[0, 0])


@KINDS
@pytest.mark.parametrize(
    ("content", "error", "match"),
    [
        ({"freq": FREQ}, LabelError, "no array 'data'"),
        ({"frequency": FREQ, "data": DATA}, LabelError, "no array 'freq'.*'frequency'"),
        ({"freq": np.append(FREQ, 11.0), "data": DATA}, ShapeError, "is not the 5 frequencies"),
        ({"freq": FREQ, "data": DATA[0]}, ShapeError, "has shape"),
        ({"freq": FREQ[::-1], "data": DATA}, ModelError, "increase"),
        ({"freq": FREQ + 0.1j, "data": DATA}, ModelError, "complex"),
        ({"freq": FREQ, "data": "none"}, FlexplantError, "holds no numbers"),
        ({"freq": FREQ, "data": DATA, "quantity": "speed"}, LabelError, "quantity"),
        ({"freq": FREQ, "data": np.nan * DATA}, ModelError, "NaN"),
    ],
)
def test_bad_content(tmp_path, kind, content, error, match):
    with pytest.raises(error, match=match):
        READERS[kind](save(tmp_path, kind, **content))


@KINDS
def test_foreign_and_cut_files(tmp_path, kind):
    content = save(tmp_path, kind, freq=FREQ, data=DATA).read_bytes()
    part = tmp_path / f"part.{kind}"
    for cut in np.linspace(0, len(content) - 10, 50).astype(int).tolist():
        part.write_bytes(content[:cut])
        with pytest.raises(FlexplantError):
            READERS[kind](part)
    with pytest.raises(FileNotFoundError):
        READERS[kind](tmp_path / "none")


def test_what_belongs_elsewhere(tmp_path):
    Frf(FREQ, DATA).save(tmp_path / "own.npz")
    with pytest.raises(FlexplantError, match=r"flexplant\.load"):
        read_frf_npz(tmp_path / "own.npz")
    np.save(tmp_path / "one.npy", FREQ)
    with pytest.raises(FlexplantError, match="one array only"):
        read_frf_npz(tmp_path / "one.npy")
