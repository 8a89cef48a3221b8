"""Models whose coordinates or matrices lost digits on their way: free bodies stay free."""

import re

import numpy as np
import pytest
import scipy.io
import scipy.linalg as la
import scipy.sparse as sp

import flexplant as fx
from flexplant.errors import FlexplantWarning, ModelError
from flexplant.structure import FEMatrices, FEModel, Spring
from flexplant.structure.definite import digits_of
from meshes import dofs_of, solid
from shared_data import data_file, needs

NASTRAN = data_file("fe/nastran")


def rounded(values, digits):
    """To so many significant decimal digits each."""
    return np.array([float(f"{v:.{digits - 1}e}") for v in np.ravel(values)]).reshape(
        np.shape(values)
    )


def text_of(matrix, digits):
    found = sp.coo_array(matrix)
    return sp.csc_array((rounded(found.data, digits), found.coords), shape=found.shape)


def plate(elements=(7, 5)):
    return fx.kirchhoff_plate(
        size=(0.61234567, 0.4712345), thickness=0.0272, elements=elements, density=2702,
        youngs_modulus=70e9, poisson_ratio=0.35,
    )  # fmt: skip


def elastic(model, count=6):
    """Dense, by the definite pencil (M, K + s M): no rigid-body basis enters."""
    K, M = model.K.toarray(), model.M.toarray()
    s = 1e4
    found = 1 / la.eigh(M, K + s * M, eigvals_only=True)[::-1] - s
    found = found[found > 1e3][:count]
    return np.sqrt(found) / (2 * np.pi)


@pytest.mark.parametrize("digits", [9, 6, 4])
def test_a_free_plate_with_few_digits_in_its_coordinates(digits):
    exact = plate()
    few = exact.dofs.replace(xyz=rounded(exact.dofs.xyz, digits), interpolation=None)
    model = FEModel(exact.M, exact.K, dofs=few)
    R = model.rigid_body
    assert R.shape == (144, 3)
    assert np.abs(R.T @ (exact.M @ R) - np.eye(3)).max() < 1e-12
    # the directions stay what they were called: z, rx, ry
    same = np.diag(R.T @ (exact.M @ exact.rigid_body))
    assert same == pytest.approx(1.0, abs=10.0 ** (1 - digits))
    # the report judges as the model does, with its matrices alone too
    for report in (fx.check(model), fx.check(FEMatrices(exact.K, exact.M, dofs=few))):
        assert report.ok
        assert (report.n_rigid, report.rigid, report.mechanisms) == (3, ("z", "rx", "ry"), ())
    modes = fx.solve_modes(model, count=9)
    assert modes.freq[:3].tolist() == [0, 0, 0]
    assert modes.freq[3:] == pytest.approx(elastic(exact), rel=1e-9)


def test_a_free_solid_with_six_digits_in_its_coordinates():
    mesh = solid(3, 2, 2, size=(0.3123456789, 0.21234567, 0.2456789123))
    dofs = dofs_of(mesh)
    model = FEModel(mesh[0], mesh[1], dofs=dofs.replace(xyz=rounded(dofs.xyz, 6)))
    assert model.rigid_body.shape[1] == 6
    modes = fx.solve_modes(model, count=12)
    assert modes.freq[:6].tolist() == [0] * 6
    assert modes.freq[6:] == pytest.approx(elastic(model), rel=1e-9)


def test_what_a_soft_spring_holds_is_not_freed():
    """The suspended plate rocks at about 1 Hz, 1e-9 of its stiffness."""
    exact = plate().with_parts([Spring(f"{n}:z", 100.0) for n in (1, 8, 41)])
    few = exact.dofs.replace(xyz=rounded(exact.dofs.xyz, 6), interpolation=None)
    model = FEModel(exact.M, exact.K, dofs=few)
    assert model.rigid_body.shape[1] == 0
    low = fx.solve_modes(model, count=3).freq
    K, M, R = exact.K.toarray(), exact.M.toarray(), plate().rigid_body
    # stiff plate: its three rigid motions on the springs
    by_hand = np.sqrt(la.eigvalsh(R.T @ K @ R, R.T @ M @ R)) / (2 * np.pi)
    assert low == pytest.approx(by_hand, rel=1e-4)


@pytest.mark.slow
@pytest.mark.parametrize("stiffness", [1e2, 1e3])
def test_a_large_structure_on_soft_springs_is_not_free(stiffness):
    """Suspended at 0.4 to 4 Hz, 1e-12 of the stiffness of its elements."""
    free = fx.kirchhoff_plate(
        size=(0.6, 0.45), thickness=0.0272, elements=(60, 45), density=2702, youngs_modulus=70e9,
        poisson_ratio=0.35,
    )  # fmt: skip
    places = [free.dofs.nearest(p, "z") for p in ((0, 0, 0), (0.6, 0, 0), (0.3, 0.45, 0))]
    model = free.with_parts([Spring(place, stiffness) for place in places])
    assert free.rigid_body.shape[1] == 3
    assert model.rigid_body.shape[1] == 0
    R, rows = free.rigid_body, free.dofs.indices(places)
    by_hand = np.sqrt(la.eigvalsh(stiffness * R[rows].T @ R[rows])) / (2 * np.pi)
    assert fx.solve_modes(model, count=4).freq[:3] == pytest.approx(by_hand, rel=1e-3)
    two = free.with_parts(Spring(places[0], stiffness))
    assert two.rigid_body.shape[1] == 2


def test_coordinates_of_another_shape_free_nothing():
    exact = plate()
    other = exact.dofs.replace(xyz=exact.dofs.xyz * [1.0, 1.05, 1.0], interpolation=None)
    assert FEModel(exact.M, exact.K, dofs=other).rigid_body.shape[1] == 1 + 1  # z and ry


@pytest.mark.parametrize("digits", [10, 9])
def test_text_that_holds_a_free_plate_by_rounding_is_named_and_can_be_freed(digits):
    exact = plate()
    few = exact.dofs.replace(xyz=rounded(exact.dofs.xyz, 7), interpolation=None)
    text = FEMatrices(text_of(exact.K, digits), text_of(exact.M, 16), dofs=few, digits=digits)
    with pytest.warns(FlexplantWarning, match=r"rigid-body motions are held.*model\(free=True\)"):
        text.model()
    modes = fx.solve_modes(text.model(free=True), count=9)
    assert modes.n_rigid == 3
    assert modes.freq[3:] == pytest.approx(elastic(exact), rel=1e-6)


def test_an_indefinite_text_says_that_its_digits_are_to_blame():
    exact = plate(elements=(11, 7))
    text = FEMatrices(text_of(exact.K, 8), exact.M, dofs=exact.dofs, digits=8)
    with pytest.raises(ModelError, match=r"not positive semi-definite.*3 of its.*free=True"):
        text.model()


def test_freeing_what_is_held_is_refused():
    held = plate().fixed(["1:z", "1:rx", "1:ry"])
    text = FEMatrices(text_of(held.K, 12), held.M, dofs=held.dofs, digits=12)
    with pytest.raises(ModelError, match="the structure is held"):
        text.model(free=True)
    with pytest.raises(ModelError, match="free must be True or False"):
        text.model(free="yes")


@pytest.mark.slow
@needs(NASTRAN)
def test_the_aircraft_with_its_coordinates_becomes_a_free_model(tmp_path):
    """Six rigid-body modes at exactly 0, the others as the f06 prints them."""
    printed = (NASTRAN / "femv5p1.f06").read_text(encoding="latin-1")
    cards = re.findall(r"^ +\d+- {8}(.{1,80}?) *$", printed, flags=re.MULTILINE)
    (tmp_path / "plane.bdf").write_text("\n".join(cards) + "\n")
    table = printed[printed.index("R E A L   E I G E N V A L U E S") :]
    rows = re.findall(r"^ +(\d+) +\d+ +(\d\.\d+E[+-]\d+) ", table, flags=re.MULTILINE)
    values = {int(mode): float(value) for mode, value in reversed(rows)}
    with pytest.warns(FlexplantWarning, match="10 digits"):
        model = fx.read_model(
            NASTRAN / "femv5p1.pch", nodes=tmp_path / "plane.bdf", massless="condense", free=True
        )
    modes = fx.solve_modes(model, count=20)
    assert modes.n_rigid == 6
    assert modes.freq[:6].tolist() == [0] * 6
    ours = modes.omega[6:] ** 2 / [values[mode] for mode in range(7, 21)] - 1
    # ten printed digits lose the softest mode, as the warning says
    assert -0.0075 < ours[0] < -0.006
    assert np.abs(ours[1:]).max() < 3e-4


def test_single_precision_has_seven_digits():
    """Rounding of float32 holds a free plate: the same as a text of seven digits."""
    exact = plate()
    K, M = exact.K.toarray().astype(np.float32), exact.M.toarray().astype(np.float32)
    for given in (K, sp.csc_array(K), [list(row) for row in K]):
        single = FEMatrices(given, M, dofs=exact.dofs)
        assert single.digits == 7
    assert FEMatrices(np.eye(2, dtype=np.float16)).digits == 3
    for double in (K.astype(np.float64), K.astype(np.int64), exact.K):
        assert FEMatrices(double).digits is None
    report = fx.check(single)
    assert report.ok
    assert (report.rigid, report.n_rigid, report.n_zero) == (("z", "rx", "ry"), 3, 3)
    assert "held by nothing but the rounding of K's entries to 7 digits" in str(report)
    assert report.first_freq == pytest.approx(elastic(exact)[0], rel=1e-5)
    with pytest.raises(ModelError, match=r"3 of its rigid-body motions.*7 digits.*free=True"):
        single.model()
    with pytest.raises(ModelError, match=r"3 of its rigid-body motions.*7 digits.*free=True"):
        FEModel(M, K, dofs=exact.dofs)
    modes = fx.solve_modes(single.model(free=True), count=9)
    assert modes.freq[:3].tolist() == [0, 0, 0]
    assert modes.freq[3:] == pytest.approx(elastic(exact), rel=2e-5)


def test_single_precision_that_happens_to_be_definite_warns():
    """Rounding that stiffens holds the plate at about 1 Hz, which no factorisation refuses."""
    exact = plate()
    K = exact.K.toarray()
    up = np.diag(np.spacing(np.diag(K).astype(np.float32)) * 0.5)
    K = (K + up).astype(np.float32)
    with pytest.warns(FlexplantWarning, match=r"held by nothing but the rounding.*free=True"):
        model = FEModel(exact.M, K, dofs=exact.dofs)
    assert 0.1 < fx.solve_modes(model, count=3).freq[0] < 10
    exact_in_single = FEModel(
        np.eye(2, dtype="f4"),
        np.array([[5, -5], [-5, 5]], "f4"),
        dofs=fx.DofSet([1, 2], ["z", "z"], np.zeros((2, 3))),
    )
    assert exact_in_single.rigid_body.shape[1] == 1


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["npz", "sparse npz", "npy", "mat v5", "mat v7.3"])
def test_single_precision_in_files(tmp_path, kind):
    K = np.array([[2, -1.1], [-1.1, 3]], np.float32)
    path = tmp_path / {"n": "K.npz", "s": "K.npz", "m": "K.mat"}[kind[0]]
    path = path.with_suffix(".npy") if kind == "npy" else path
    if kind == "npz":
        np.savez(path, K=K, M=np.eye(2))
    elif kind == "sparse npz":
        sp.save_npz(path, sp.csc_array(K))
    elif kind == "npy":
        np.save(path, K)
    elif kind == "mat v5":
        scipy.io.savemat(path, {"K": K, "M": np.eye(2)})
    else:
        h5py = pytest.importorskip("h5py")
        with h5py.File(path, "w", userblock_size=512) as file:
            file["K"] = K
        with path.open("r+b") as file:
            file.write(b"MATLAB 7.3 MAT-file".ljust(124) + b"\0\2IM")
    assert fx.read_matrices(path).digits == 7


@pytest.mark.slow
def test_entries_show_the_digits_of_a_text():
    """K read from a text by the user: its entries show the digits, unless they are exact."""
    exact = plate((16, 12))
    with pytest.warns(FlexplantWarning, match="rounding of K.s entries to 9 digits"):
        FEModel(exact.M, text_of(exact.K, 9), dofs=exact.dofs)
    with pytest.raises(ModelError, match="rounding of K's entries to 6 digits"):
        FEModel(exact.M, text_of(exact.K, 6), dofs=exact.dofs)
    # no text: springs of round numbers, and arithmetic in double precision
    springs = 1e3 * np.arange(1.0, 60.0)
    assert digits_of(np.diag(springs)) is None
    for kind in ("coo", "lil", "csr"):
        assert digits_of(exact.K.asformat(kind)) is None
    assert digits_of(np.array([0.0, 1e-300, np.inf])) is None
