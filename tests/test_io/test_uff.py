"""Universal files: written by pyuff and by hand, with signs, units, gaps and damage."""

import re
import sys
import warnings

import numpy as np
import pytest

import flexplant as fx
import shared_data
from flexplant.errors import FlexplantError, LabelError, ModelError
from flexplant.io import read_frf_uff, read_modes_uff, read_nodes_uff
from uff_files import analysis

pyuff = pytest.importorskip("pyuff")
SHARED = shared_data.data_file("fe/uff")
FREQ = np.arange(1, 33) * 0.5
RNG = np.random.default_rng(3)
#: (output, input): accelerance
DATA = {
    (out, into): RNG.normal(size=32) + 1j * RNG.normal(size=32)
    for out in ((2, 3), (41, 3), (41, 4))
    for into in ((2, 3), (7, 1))
}


def record(out, into, data, **changes):
    fields = {
        "type": 58,
        "binary": 0,
        "func_type": 4,
        "rsp_node": out[0],
        "rsp_dir": out[1],
        "ref_node": into[0],
        "ref_dir": into[1],
        "data": data,
        "x": FREQ,
        "id1": "id1",
        "rsp_ent_name": "NONE",
        "ref_ent_name": "NONE",
        "abscissa_spacing": 1,
        "abscissa_spec_data_type": 18,
        "ordinate_spec_data_type": 12,
        "orddenom_spec_data_type": 13,
        "abscissa_axis_units_lab": "Hz",
        "ordinate_axis_units_lab": "m/s^2",
        "orddenom_axis_units_lab": "N",
        "orddenom_len_unit_exp": 0,
        "z_axis_value": 0,
    }
    return fields | changes


def units(length=1.0, force=1.0):
    return {
        "type": 164,
        "units_code": 9,
        "length": length,
        "force": force,
        "temp": 1.0,
        "temp_offset": 0.0,
    }


def written(tmp_path, sets, name="a.uff"):
    path = tmp_path / name
    path.unlink(missing_ok=True)
    file = pyuff.UFF(str(path))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ResourceWarning)  # pyuff leaves the file open
        for item in sets:
            file.write_sets(dict(item), "add")
    return path


@pytest.mark.parametrize("binary", [0, 1])
def test_records_become_one_frf(tmp_path, binary):
    sets = [record(*pair, data, binary=binary) for pair, data in reversed(DATA.items())]
    frf = read_frf_uff(written(tmp_path, sets))
    assert frf.outputs == ("2:z", "41:z", "41:rx")
    assert frf.inputs == ("u 2:z", "u 7:x")
    assert frf.quantity == "acceleration"
    assert frf.freq == pytest.approx(FREQ)
    assert frf["41:rx", "u 7:x"] == pytest.approx(DATA[(41, 4), (7, 1)], rel=1e-4)
    assert frf["2:z", "u 7:x"] == pytest.approx(DATA[(2, 3), (7, 1)], rel=1e-4)
    assert frf.coherence is None


def test_a_record_written_by_hand(tmp_path):
    """Columns as in the description of dataset 58: uneven frequencies, double precision."""
    lines = [
        "    -1",
        "    58",
        "a test",
        "NONE",
        "01-JAN-20 12:00:00",
        "NONE",
        "NONE",
        "    4         0    0         0 NONE              41  -3 NONE               7   1",
        "         6         3         0  0.00000E+00  0.00000E+00  0.00000E+00",
        "        18    0    0    0 Frequency            Hz                  ",
        "         8    1    0    0 Displacement         mm                  ",
        "        13    0    1    0 Force                N                   ",
        "         0    0    0    0 NONE                 NONE                ",
        "  1.00000E+00  1.500000000000E+00 -2.500000000000E+00",
        "  2.50000E+00  3.500000000000E+00  4.500000000000E+00",
        "  7.00000E+00 -5.500000000000E+00  6.500000000000E+00",
        "    -1",
    ]
    path = tmp_path / "hand.uff"
    path.write_text("\n".join(lines) + "\n")
    frf = read_frf_uff(path)
    assert frf.freq.tolist() == [1.0, 2.5, 7.0]
    assert (frf.outputs, frf.inputs, frf.quantity) == (("41:z",), ("u 7:x",), "displacement")
    # millimetres, and the direction -3 turns the sign
    given = np.array([1.5 - 2.5j, 3.5 + 4.5j, -5.5 + 6.5j])
    assert frf.data[0, 0] == pytest.approx(-1e-3 * given)


def test_signs_of_both_directions(tmp_path):
    one = DATA[(2, 3), (2, 3)]
    for out, into, sign in (((2, -3), (2, 3), -1), ((2, -3), (2, -3), 1), ((2, 3), (2, -3), -1)):
        frf = read_frf_uff(written(tmp_path, [record(out, into, one)]))
        assert frf["2:z", "u 2:z"] == pytest.approx(sign * one, rel=1e-4)


def test_rotations_and_moments_have_their_units(tmp_path):
    """Also under other names; a force and a translation keep theirs."""
    pairs = [((out, way), (7, to)) for out, way in ((2, 3), (41, -5)) for to in (1, 6)]
    frf = read_frf_uff(written(tmp_path, [record(*pair, DATA[(2, 3), (2, 3)]) for pair in pairs]))
    renamed = frf.replace(outputs=["gap", "tilt"]).replace(inputs=["push", "turn"])
    for one in (frf, renamed):
        found = [one.unit(*channel) for channel in one]
        assert found == ["m/s^2/N", "m/s^2/(N m)", "rad/s^2/N", "rad/s^2/(N m)"]
    assert "[rad/s^2/(N m)]" in repr(renamed.select(["tilt"], ["turn"]))


def test_kinds_are_converted_when_asked(tmp_path):
    one = DATA[(2, 3), (2, 3)]
    sets = [
        record((1, 3), (2, 3), one),
        record((2, 3), (2, 3), one, ordinate_spec_data_type=11, ordinate_axis_units_lab="m/s"),
        record((3, 3), (2, 3), one, ordinate_spec_data_type=8, ordinate_axis_units_lab="m"),
    ]
    path = written(tmp_path, sets)
    with pytest.raises(ModelError, match="acceleration', 'displacement', 'velocity'"):
        read_frf_uff(path)
    frf = read_frf_uff(path, quantity="velocity")
    s = 2j * np.pi * FREQ
    assert frf.quantity == "velocity"
    for name, factor in (("1:z", 1 / s), ("2:z", 1), ("3:z", s)):
        assert frf[name, "u 2:z"] == pytest.approx(one * factor, rel=1e-4)
    with pytest.raises(LabelError, match="quantity"):
        read_frf_uff(path, quantity="speed")
    unknown = written(tmp_path, [record((1, 3), (2, 3), one, ordinate_spec_data_type=1)])
    assert read_frf_uff(unknown).quantity is None
    stated = read_frf_uff(unknown, quantity="velocity")
    assert stated.quantity == "velocity"
    assert stated.data[0, 0] == pytest.approx(one, rel=1e-4)
    zero = written(tmp_path, [record((1, 3), (2, 3), one, x=FREQ - 0.5, abscissa_min=0.0)])
    with pytest.raises(ModelError, match="zero frequency"):
        read_frf_uff(zero, quantity="displacement")


@pytest.mark.parametrize(
    ("above", "below", "factor"),
    [
        ("m/s^2", "N", 1),
        ("m/s2/N", "NONE", 1),
        ("g", "N", 9.80665),
        ("g/N", "", 9.80665),
        ("mm/s^2", "kN", 1e-6),
        ("in/s^2", "lbf", 0.0254 / 4.4482216152605),
        ("(m/s^2)", "mN", 1e3),
        ("NONE", "NONE", 1),
    ],
)
def test_units_of_the_axes(tmp_path, above, below, factor):
    one = DATA[(2, 3), (2, 3)]
    labels = {"ordinate_axis_units_lab": above, "orddenom_axis_units_lab": below}
    path = written(tmp_path, [record((2, 3), (2, 3), one, **labels)])
    assert read_frf_uff(path).data[0, 0] == pytest.approx(factor * one, rel=1e-4)
    assert read_frf_uff(path, scale=3.0).data[0, 0] == pytest.approx(3 * one, rel=1e-4)


@pytest.mark.parametrize("binary", [0, 1])
@pytest.mark.parametrize(
    ("above", "below", "factor"),
    [("m/s²", "N", 1), ("mm/s²", "N", 1e-3), ("µm/s²", "N", 1e-6), ("m/s²/N", "NONE", 1)],
)
@pytest.mark.parametrize("encoding", ["latin-1", "utf-8"])
def test_units_and_names_in_latin_1(tmp_path, binary, above, below, factor, encoding):
    """As older software writes them, in a dataset that is not the first."""
    one = np.linspace(1.0, 2.0, 32) * (1 + 1j)
    labels = {"ordinate_axis_units_lab": "UNIT", "orddenom_axis_units_lab": below}
    labels |= {"binary": binary, "rsp_ent_name": "TUER", "ref_ent_name": "NONE"}
    plain = record((2, 3), (2, 3), one, binary=binary)
    path = written(tmp_path, [nodes(15), plain, record((5, 0), (2, 3), one, **labels)])
    content = path.read_bytes().replace(b"TUER", "Tür ".encode(encoding))
    unit = above.encode(encoding)
    path.write_bytes(content.replace(b"UNIT".ljust(len(unit)), unit))
    frf = read_frf_uff(path)
    assert frf.outputs == ("2:z", "Tür")
    assert frf.data[1, 0] == pytest.approx(factor * one, rel=1e-4)


def test_units_of_dataset_164(tmp_path):
    one = DATA[(2, 3), (2, 3)]
    nameless = {"ordinate_axis_units_lab": "NONE", "orddenom_axis_units_lab": "NONE"}
    # 1000 mm are a metre, and 0.001 kN a newton
    path = written(tmp_path, [units(1e3, 1e-3), record((2, 3), (2, 3), one, **nameless)])
    assert read_frf_uff(path).data[0, 0] == pytest.approx(1e-6 * one, rel=1e-4)
    path = written(tmp_path, [units(1e3, 1.0), record((2, 3), (2, 3), one)])
    with pytest.raises(ModelError, match="contradict"):
        read_frf_uff(path)
    assert read_frf_uff(path, scale=1.0).data[0, 0] == pytest.approx(one, rel=1e-4)
    path = written(tmp_path, [record((2, 3), (2, 3), one, ordinate_axis_units_lab="V")])
    with pytest.raises(ModelError, match=r"'V' per 'N'.*scale="):
        read_frf_uff(path)


def test_coherence(tmp_path):
    gamma = np.linspace(0.5, 1.0000001, 32)
    sets = [record(*pair, data) for pair, data in DATA.items()]
    coherent = [
        record(*pair, gamma * (0.9 if i else 1), func_type=6) for i, pair in enumerate(DATA)
    ]
    frf = read_frf_uff(written(tmp_path, sets + coherent))
    assert frf.coherence.shape == (3, 2, 32)
    assert frf.coherence[0, 0] == pytest.approx(gamma, rel=1e-4)
    assert frf.coherence[2, 1] == pytest.approx(0.9 * gamma, rel=1e-4)
    path = written(tmp_path, sets + coherent[:-1])
    with pytest.raises(FlexplantError, match=r"does not contain 1 of 6 coherences: 41:rx <- u 7:x"):
        read_frf_uff(path)
    assert read_frf_uff(path, coherence=False).coherence is None


def test_missing_doubled_and_uneven_pairs_are_listed(tmp_path):
    sets = [record(*pair, data) for pair, data in DATA.items()]
    with pytest.raises(FlexplantError, match=r"does not contain 1 of 6 .*2:z <- u 7:x"):
        read_frf_uff(written(tmp_path, [sets[0], *sets[2:]]))
    with pytest.raises(FlexplantError, match="2:z <- u 2:z more than once"):
        read_frf_uff(written(tmp_path, [*sets, sets[0]]))
    other = sets[1] | {"x": 1.01 * FREQ}
    with pytest.raises(FlexplantError, match=r"2:z <- u 7:x .* at other frequencies"):
        read_frf_uff(written(tmp_path, [sets[0], other, *sets[2:]]))
    with pytest.raises(FlexplantError, match="not over frequency"):
        read_frf_uff(written(tmp_path, [sets[0] | {"abscissa_spec_data_type": 17}]))
    with pytest.raises(FlexplantError, match=r"function types \[6\]"):
        read_frf_uff(written(tmp_path, [sets[0] | {"func_type": 6, "data": np.ones(32)}]))


def test_channels_without_a_direction_are_named_by_their_entity(tmp_path):
    one = DATA[(2, 3), (2, 3)]
    frf = read_frf_uff(
        written(tmp_path, [record((5, 0), (6, 0), one, rsp_ent_name="tip", ref_ent_name="NONE")])
    )
    assert (frf.outputs, frf.inputs) == (("tip",), ("u 6",))


def shape(number, **changes):
    values = RNG.normal(size=(3, 4))
    fields = {
        "type": 55,
        "model_type": 1,
        "analysis_type": 2,
        "data_ch": 2,
        "spec_data_type": 8,
        "data_type": 2,
        "r1": values[0],
        "r2": 0 * values[1],
        "r3": values[2],
        "n_data_per_node": 3,
        "node_nums": np.array([4, 7, 9, 1]),
        "load_case": 1,
        "mode_n": number,
        "modal_m": 1.0,
        "freq": 10.0 * number,
        "modal_damp_vis": 0.01 * number,
        "modal_damp_his": 0.0,
    }
    return fields | changes


def test_normal_modes(tmp_path):
    sets = [shape(1), shape(2), shape(3, modal_damp_vis=0.0, modal_damp_his=0.04)]
    path = written(tmp_path, sets)
    modes = read_modes_uff(path)
    omega = 2 * np.pi * np.array([10.0, 20.0, 30.0])
    zeta = np.array([0.01, 0.02, 0.02])
    wanted = omega * (-zeta + 1j * np.sqrt(1 - zeta**2))
    assert modes.poles == pytest.approx(wanted, rel=1e-5)
    # y is zero everywhere: it was not measured
    assert modes.dofs == tuple(f"{n}:{d}" for n in (4, 7, 9, 1) for d in "xz")
    assert modes.shapes[::2, 1] == pytest.approx(sets[1]["r1"], rel=1e-4)
    assert modes.shapes[1::2, 2] == pytest.approx(sets[2]["r3"], rel=1e-4)
    assert modes.modes is None
    assert read_modes_uff(path, modes=[3, 1]).poles == pytest.approx(wanted[[2, 0]], rel=1e-5)
    with pytest.raises(LabelError, match=r"no mode 4.*\[1, 2, 3\]"):
        read_modes_uff(path, modes=[4])


def test_complex_modes(tmp_path):
    eig = -3.0 + 77.0j
    values = RNG.normal(size=(2, 4)) + 1j * RNG.normal(size=(2, 4))
    one = shape(
        1,
        analysis_type=3,
        data_type=5,
        eig=eig,
        modal_a=1 + 0j,
        modal_b=1 + 0j,
        r1=values[0],
        r2=0 * values[0],
        r3=values[1],
    )
    modes = read_modes_uff(written(tmp_path, [one]))
    assert modes.poles == pytest.approx([eig], rel=1e-5)
    assert modes.shapes[::2, 0] == pytest.approx(values[0], rel=1e-4)


def test_modes_that_do_not_belong_together(tmp_path):
    with pytest.raises(ModelError, match=r"modes \[1\].*modes=\[2\]"):
        read_modes_uff(written(tmp_path, [shape(1, freq=0.0), shape(2)]))
    with pytest.raises(FlexplantError, match="mode 2 is at other nodes"):
        read_modes_uff(written(tmp_path, [shape(1), shape(2, node_nums=np.array([4, 7, 9, 2]))]))
    with pytest.raises(FlexplantError, match="mode 1 twice"):
        read_modes_uff(written(tmp_path, [shape(1), shape(1)]))
    with pytest.raises(FlexplantError, match="no mode shapes"):
        read_modes_uff(written(tmp_path, [units()]))


@pytest.mark.parametrize("binary", [0, 1])
def test_a_file_cut_within_a_dataset_says_so(tmp_path, binary):
    """Wherever it was cut: pyuff reads the datasets before it as if there were no others."""
    some = [units(), nodes(15), nodes(2411, node_nums=[4, 9]), shape(1), shape(2)]
    some.append(record((2, 3), (2, 3), DATA[(2, 3), (2, 3)], binary=binary))
    path = written(tmp_path, some)
    content, whole = path.read_bytes(), len(read_modes_uff(path))
    assert whole == 2
    ends = [found.end() for found in re.finditer(rb"    -1\r?\n", content)][1::2]
    for end, start in zip(ends, [0, *ends], strict=False):
        for cut in np.linspace(start + 8, end - 2, 7).astype(int):
            path.write_bytes(content[:cut])
            for read in (read_modes_uff, read_nodes_uff, read_frf_uff):
                with pytest.raises(FlexplantError, match=r"is cut off: dataset .* has no end"):
                    read(path)


@shared_data.needs(SHARED)
def test_files_of_others():
    modes = read_modes_uff(SHARED / "uff55_translation_rotation.uff")
    assert modes.freq == pytest.approx([97.013])
    assert modes.dofs[:3] == ("1:x", "1:y", "1:z")
    assert modes.shapes[0, 0] == pytest.approx(5.3569e-2)
    with pytest.raises(FlexplantError, match=r"function types \[1\].*estimate_frf"):
        read_frf_uff(SHARED / "Sample_UFF58b_bin.uff")


def nodes(kind, **changes):
    fields = {
        "type": kind,
        "node_nums": [3, 8],
        "def_cs": [0, 1],
        "disp_cs": [0, 0],
        "color": [1, 1],
        "x": [1.0, 2.0],
        "y": [3.0, 4.0],
        "z": [5.0, 6.0],
    }
    return fields | changes


@pytest.mark.parametrize("kind", [15, 2411])
def test_nodes(tmp_path, kind):
    dofs = read_nodes_uff(written(tmp_path, [units(1e3), nodes(kind)]), directions=("z", "rx"))
    assert dofs.labels == ("3:z", "3:rx", "8:z", "8:rx")
    assert dofs.xyz[::2].tolist() == pytest.approx(
        np.array([[1e-3, 3e-3, 5e-3], [2e-3, 4e-3, 6e-3]])
    )
    assert read_nodes_uff(written(tmp_path, [nodes(kind)])).xyz[3].tolist() == [2.0, 4.0, 6.0]
    with pytest.raises(ModelError, match="node 8 in coordinate system 4"):
        read_nodes_uff(written(tmp_path, [nodes(kind, def_cs=[0, 4])]))
    with pytest.raises(ModelError, match="moves node 3 in coordinate system 7"):
        read_nodes_uff(written(tmp_path, [nodes(kind, disp_cs=[7, 0])]))
    with pytest.raises(FlexplantError, match="no nodes"):
        read_nodes_uff(written(tmp_path, [units()]))


def systems(**changes):
    straight = np.vstack([np.eye(3), np.zeros((1, 3))])
    fields = {
        "type": 2420,
        "CS_sys_labels": [1],
        "CS_types": [0],
        "CS_colors": [8],
        "CS_names": ["one"],
        "CS_matrices": [straight],
    }
    return fields | changes


def results(tmp_path, *sets):
    path = written(tmp_path, [units(1e3), nodes(2411, node_nums=[4, 9])], "m.unv")
    path.write_text(path.read_text() + "".join(sets))
    return path


def test_modes_that_a_finite_element_program_computed(tmp_path):
    """Dataset 2414 in mm and t: Modes with places, in SI; a complex mode is a measured one."""
    shapes = np.array([[[0.0, 0, 3, 0.2, 0, 0], [0, 0, -2, 0.1, 0, 0]], np.ones((2, 6))])
    sets = [
        analysis(2, shape, mode=k + 1, freq=20.0 * k, real=(0.0, 4.0, 0.01 * k))
        for k, shape in enumerate(shapes)
    ]
    stress = analysis(2, np.ones((2, 3)), mode=1, freq=20.0, result=2)
    path = results(tmp_path, stress, *sets)
    modes = fx.io.read_modes(path, zeta=None)
    assert (modes.n_rigid, modes.freq[1]) == (1, pytest.approx(20.0))
    np.testing.assert_allclose(modes.zeta, [0.0, 0.01])
    assert modes.dofs.labels[:4] == ("9:x", "9:y", "9:z", "9:rx")
    np.testing.assert_allclose(modes.dofs.xyz[0], [0.002, 0.004, 0.006])
    # 1/sqrt(t) in 1/sqrt(kg), of generalised mass 4 t; rotations per mm
    np.testing.assert_allclose(modes.at("9:z"), np.array([3, 1]) / np.sqrt(4e3))
    np.testing.assert_allclose(modes.at("4:rx"), np.array([0.1, 1]) / np.sqrt(4e3) * 1e3)
    mine = fx.io.read_modes(path, zeta=None, units=("m", "kg", "s"))
    np.testing.assert_allclose(mine.at("9:z"), [1.5, 0.5])
    with pytest.raises(FlexplantError, match=r"no normal modes: displacements .* 2414"):
        fx.io.read_modes(results(tmp_path, stress), zeta=None)
    swing = np.array([[1 + 2j, 0, 0.5j], [-1 - 1j, 0, 3]])
    eigen = (0.0, 0.0, 0.0, 0.0, -3.0, 77.0)
    one = read_modes_uff(results(tmp_path, analysis(7, swing, mode=5, real=eigen)))
    np.testing.assert_allclose(one.poles, [-3 + 77j])
    assert one.dofs == ("9:x", "9:z", "4:x", "4:z")
    np.testing.assert_allclose(one.shapes[:, 0], swing[:, ::2].ravel())


def test_responses_that_a_finite_element_program_computed(tmp_path):
    rng = np.random.default_rng(3)
    data = rng.normal(size=(2, 3, 2, 3)) + 1j * rng.normal(size=(2, 3, 2, 3))
    data[..., 1] = 0.0
    freq = [5.0, 20.0, 80.0]
    sets = [
        analysis(5, data[k, i], load=k + 1, freq=f) for i, f in enumerate(freq) for k in range(2)
    ]
    found = read_frf_uff(results(tmp_path, *sets[::-1]))
    assert (found.inputs, found.outputs) == (("load 1", "load 2"), ("9:x", "9:z", "4:x", "4:z"))
    np.testing.assert_allclose(found.freq, freq)
    wanted = np.moveaxis(data[..., ::2].reshape(2, 3, 4), (0, 1, 2), (1, 2, 0)) * 1e-3
    np.testing.assert_allclose(found.data, wanted, rtol=1e-5)
    fast = read_frf_uff(results(tmp_path, *sets), quantity="velocity", scale=1.0)
    np.testing.assert_allclose(fast.data, wanted * 1e3 * 2j * np.pi * found.freq, rtol=1e-5)
    with pytest.raises(FlexplantError, match="load set 2 at 20 Hz twice"):
        read_frf_uff(results(tmp_path, *sets, sets[3]))
    with pytest.raises(FlexplantError, match="load set 2 at other frequencies"):
        read_frf_uff(results(tmp_path, *sets[:-1]))
    both = [*sets, *(analysis(5, data[0, 0], load=1, freq=f, result=12) for f in freq)]
    with pytest.raises(ModelError, match="in acceleration, displacement"):
        read_frf_uff(results(tmp_path, *both))
    with pytest.raises(FlexplantError, match="has no end"):
        read_frf_uff(results(tmp_path, *sets, "    -1\n  2414\n"))


@pytest.mark.parametrize("binary", [0, 1])
def test_cut_files(tmp_path, binary):
    sets = [record(*pair, data, binary=binary) for pair, data in list(DATA.items())[:2]]
    content = written(tmp_path, sets).read_bytes()
    part = tmp_path / "part.uff"
    for cut in np.linspace(0, len(content) - 40, 50).astype(int).tolist():
        part.write_bytes(content[:cut])
        try:
            frf = read_frf_uff(part)
        except FlexplantError:
            continue
        # the first record alone is a file of its own
        assert frf.inputs == ("u 2:z",)
        assert frf.data[0, 0] == pytest.approx(DATA[(2, 3), (2, 3)], rel=1e-4)


def test_foreign_files_and_a_missing_extra(tmp_path, monkeypatch):
    path = tmp_path / "x.uff"
    path.write_text("frequency [Hz], y1 <- u1 real\n")
    for reader in (read_frf_uff, read_modes_uff, read_nodes_uff):
        with pytest.raises(FlexplantError, match="not a universal file"):
            reader(path)
        with pytest.raises(FileNotFoundError):
            reader(tmp_path / "none.uff")
    monkeypatch.setitem(sys.modules, "pyuff", None)
    with pytest.raises(FlexplantError, match=r"pip install 'flexplant\[uff\]'"):
        read_frf_uff(path)
