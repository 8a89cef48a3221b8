"""Matrices of a file before they become a model, and the meaning of their rows."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import scipy.sparse as sp

from ..arrays import (
    FloatArray,
    IntArray,
    flag,
    instance,
    name_list,
    node_numbers,
    one_of,
    positive,
    real_array,
    whole,
)
from ..dof_columns import at_nodes
from ..errors import LabelError, ModelError, ShapeError, counted, warn
from ..labels import DofSet
from ..sparse.factor import is_positive_definite
from ..store import Value, checked
from ..tolerances import SAME, TYPED
from .definite import are_swapped, digits_of, square, symmetric_matrix
from .model import FEModel
from .singular_mass import empty_rows, held_rows, inertial
from .undamped_frequencies import MOST, natural_frequencies
from .unit_systems import units
from .zero_energy_motions import endangered, freed, held_by_rounding, shown_digits


@dataclass(frozen=True, eq=False, repr=False)
class FEMatrices(Value):
    """Matrices of ``M q'' + D q' + K q = f`` as they were read from a file, errors included.

    An FEModel needs a positive definite M, known DOFs and coordinates. FEMatrices can do without
    them. `check` reports the errors. The method `model` makes an FEModel, or raises an error that
    says what is missing.

    Parameters
    ----------
    K : (n, n) array or sparse matrix
        Stiffness, with entries in both triangles. When the matrix is complex, ``K (1 + i eta)``,
        the real part is kept, and the loss factor eta becomes a modal damping ratio of eta / 2. A
        note says so, and `model` warns. Damping by a loss factor and modal damping give the same
        response at resonance, and differ by at most a fraction eta elsewhere.
    M, D : (n, n) array or sparse matrix, optional
        Mass and viscous damping. M may be singular.
    dofs : DofSet, optional
        DOFs of the rows. None: the DOFs are not known yet, and `with_dofs` can add them.
    digits : int, optional
        Number of significant decimal digits of the entries of K. This is the number printed in a
        text file, or 7 for single precision. None: double precision.
    source : str, optional
        Origin of the matrices, for display.
    constrained : sequence of str
        Labels of fixed DOFs in the file, which were dropped.
    located : bool
        Whether the coordinates in `dofs` are known. False: the file contains no coordinates, and
        those in `dofs` are zero.
    notes : sequence of str
        Changes that were made when the file was read, such as a completed triangle or dropped empty
        rows.
    loss_factor : float
        Loss factor eta of a complex K. If it differs over the structure, the mean over the rows.

    Raises
    ------
    ShapeError
        When a matrix is not square or the sizes differ.
    ModelError
        When entries are not finite real numbers.

    Examples
    --------
    Matrices of two masses become an FEModel with a total mass of 3 kg:

    >>> dofs = DofSet([1, 2], ["x", "x"], [[0, 0, 0], [1, 0, 0]])
    >>> found = FEMatrices([[5, -5], [-5, 5]], [[1, 0], [0, 2]], dofs=dofs)
    >>> found
    <FEMatrices: 2 DOFs, K (4 entries), M (2 entries)>
    >>> found.model().mass
    3.0
    """

    K: sp.csc_array
    M: sp.csc_array | None = None
    D: sp.csc_array | None = None
    dofs: DofSet | None = field(default=None, kw_only=True)
    digits: int | None = field(default=None, kw_only=True)
    source: str | None = field(default=None, kw_only=True)
    constrained: tuple[str, ...] = field(default=(), kw_only=True)
    located: bool = field(default=True, kw_only=True)
    notes: tuple[str, ...] = field(default=(), kw_only=True)
    loss_factor: float = field(default=0.0, kw_only=True, metadata=checked(positive, zero=True))

    def __post_init__(self) -> None:
        stiff: Any = self.K
        notes = name_list(self.notes, "notes")
        eta = positive(self.loss_factor, "loss_factor", zero=True)
        if not eta and np.iscomplexobj(stiff):
            stiff = stiff if sp.issparse(stiff) else np.asarray(stiff)
            eta = _loss_factor(square(stiff.real, "K"), square(stiff.imag, "imaginary part of K"))
            notes = (*notes, _modal_damping_note(eta))
        K = square(stiff.real if np.iscomplexobj(stiff) else stiff, "K")
        n = K.shape[0]
        others: dict[str, Any] = {"loss_factor": eta}
        for name, given in (("M", self.M), ("D", self.D)):
            others[name] = None if given is None else square(given, name)
            if others[name] is not None and others[name].shape != (n, n):
                raise ShapeError(
                    f"{name} must have shape ({n}, {n}) like K, got {others[name].shape}. Were "
                    "constraints applied to one matrix only?"
                )
        if self.dofs is not None:
            instance(self.dofs, DofSet, "dofs", "Pass DofSet(nodes, directions, xyz).")
        if self.dofs is not None and len(self.dofs) != n:
            raise ShapeError(
                f"K has {n} rows, but the DofSet {len(self.dofs)} DOFs. Are constrained "
                "DOFs in one of them only?"
            )
        digits = digits_of(self.K) if self.digits is None else whole(self.digits, "digits")
        self._set(
            K=K,
            **others,
            digits=digits,
            constrained=name_list(self.constrained, "constrained DOFs"),
            notes=notes,
        )

    def __repr__(self) -> str:
        stored = [f"{name} ({matrix.nnz} entries)" for name, matrix in self._matrices.items()]
        where = f" of {self.source!r}" if self.source else ""
        parts = [counted(self.n_dof, "DOF"), *stored]
        if self.constrained:
            parts.append(f"{counted(len(self.constrained), 'constrained DOF')} dropped")
        if self.digits is not None:
            parts.append(f"{self.digits} digits")
        if self.dofs is None:
            parts.append("DOFs not named")
        elif not self.located:
            parts.append("no coordinates")
        return f"<FEMatrices{where}: {', '.join(parts)}>"

    @property
    def _matrices(self) -> dict[str, Any]:
        every = {"K": self.K, "M": self.M, "D": self.D}
        return {name: matrix for name, matrix in every.items() if matrix is not None}

    @property
    def _named_dofs(self) -> DofSet:
        if self.dofs is None:
            raise LabelError("the rows have no names yet: with_dofs(dofs) gives names and places.")
        return self.dofs

    @property
    def n_dof(self) -> int:
        """Number of rows n."""
        return int(self.K.shape[0])

    @property
    def massless(self) -> tuple[str, ...]:
        """Labels of the DOFs without mass, or "row 1", "row 2", ... if the DOFs are unknown."""
        if self.M is None:
            return ()
        return self.names(np.flatnonzero(empty_rows(self.M)))

    def names(self, rows: IntArray) -> tuple[str, ...]:
        """Return the labels of rows (counted from 0), or "row 1", ... if the DOFs are unknown."""
        if self.dofs is None:
            return tuple(f"row {row + 1}" for row in rows.tolist())
        labels = self.dofs.labels
        return tuple(labels[row] for row in rows.tolist())

    def with_dofs(self, dofs: DofSet | str | Path) -> FEMatrices:
        """Return the same matrices with new DOFs for their rows.

        Parameters
        ----------
        dofs : DofSet, or path of a CSV file
            DOFs in the order of the rows, with coordinates.
        """
        given = DofSet.from_table(dofs) if isinstance(dofs, str | Path) else dofs
        instance(given, DofSet, "dofs", "Pass one, or the path of a table.")
        return self.replace(dofs=given, located=True)

    def located_at(self, nodes: Iterable[int], xyz: Any) -> FEMatrices:
        """Return the same matrices with coordinates of the nodes, which the file does not contain.

        Parameters
        ----------
        nodes : sequence of m int
            Node numbers in any order. They must include all nodes of the DOFs.
        xyz : (m, 3) array [m]
            Coordinates of the nodes.
        """
        dofs = self._named_dofs
        numbers = node_numbers(nodes)
        given = real_array(xyz, "xyz", (numbers.size, 3))
        places = at_nodes(dofs.nodes, numbers, given, "nodes")
        return self.replace(dofs=dofs.replace(xyz=places), located=True)

    def without(self, labels: Iterable[str]) -> FEMatrices:
        """Return the matrices with some DOFs held: their rows and columns are dropped.

        Parameters
        ----------
        labels : sequence of str
            Labels of the DOFs to hold, for example DOFs that a stiff spring (penalty) holds in the
            file.
        """
        dofs = self._named_dofs
        held = name_list(labels, "DOFs to hold")
        keep = np.ones(self.n_dof, dtype=bool)
        keep[dofs.indices(held)] = False
        return self._kept(np.flatnonzero(keep))

    def trimmed(self) -> FEMatrices:
        """Return the matrices without the rows of held DOFs; `constrained` keeps their labels.

        Some solvers write such rows. They are empty in every matrix, or have no mass and only a
        diagonal entry in K. Such a DOF stays at rest, so that dropping it does not change the
        result.
        """
        held = held_rows(self.K, self.M, self.D)
        if not held.any() or held.all():
            return self
        note = f"{counted(int(held.sum()), 'row')} of held DOFs dropped"
        left = self._kept(np.flatnonzero(~held))
        return left.replace(notes=(*left.notes, note))

    def _kept(self, rows: IntArray) -> FEMatrices:
        dropped = np.setdiff1d(np.arange(self.n_dof), rows)
        parts = {name: matrix[rows][:, rows] for name, matrix in self._matrices.items()}
        dofs = None if self.dofs is None else self.dofs._taken(rows)
        held = (*self.constrained, *self.names(dropped))
        return self.replace(**parts, dofs=dofs, constrained=held)

    def converted(
        self, length: str | float = "m", mass: str | float = "kg", time: str | float = "s"
    ) -> FEMatrices:
        """Return the matrices and coordinates in SI, from those in other units.

        The unit of an entry depends on its row and column. For example, an entry of K has the unit
        ``N/mm`` between two displacements and ``N mm`` between two rotations. These units follow
        from those of length, mass and time.

        Parameters
        ----------
        length, mass, time : str or float
            Present units, such as "mm", "t", "s", or the size of each unit in SI units.

        Returns
        -------
        FEMatrices
            Matrices in m, kg, s, N.

        Raises
        ------
        ModelError
            When a unit is unknown.
        LabelError
            When the DOFs have no names, since rotations are converted differently.

        Examples
        --------
        >>> dofs = DofSet([1], ["z"], [[500.0, 0, 0]])
        >>> si = FEMatrices([[12.0]], [[0.002]], dofs=dofs).converted("mm", "t").model()
        >>> float(si.K[0, 0]), si.mass, float(si.dofs.xyz[0, 0])
        (12000.0, 2.0, 0.5)
        """
        system, dofs = units(length, mass, time), self._named_dofs
        return self.replace(**system.matrices(self._matrices, dofs), dofs=system.placed(dofs))

    def rotated(self, rotations: Any) -> FEMatrices:
        """Return the matrices in global directions, from nodes with local coordinate systems.

        The direction cosines C of a node give ``q_local = C q_global`` for its three displacements,
        and in the same way for its three rotations. It follows that ``K_global = C^T K_local C``.

        Parameters
        ----------
        rotations : mapping {node: (3, 3) array}
            Direction cosines of nodes with a local system: row i holds the global components of
            local axis i.

        Raises
        ------
        LabelError
            When a node does not exist.
        ModelError
            When cosines are not orthogonal, or a node has only some of its three directions. The
            missing directions are held along local axes, which DOFs in global directions cannot
            describe.

        Examples
        --------
        >>> dofs = DofSet([1, 1, 1], ["x", "y", "z"], np.zeros((3, 3)))
        >>> turned = {1: [[0, 1, 0], [-1, 0, 0], [0, 0, 1]]}  # local x is global y
        >>> FEMatrices(np.diag([4.0, 1, 1]), dofs=dofs).rotated(turned).K.diagonal().tolist()
        [1.0, 4.0, 1.0]
        """
        C = cosines(self._named_dofs, rotations)
        turned: dict[str, Any] = {}
        for name, matrix in self._matrices.items():
            full: Any = C.T @ matrix @ C
            turned[name] = 0.5 * (full + full.T)
        return self.replace(**turned)

    def frequencies(self, count: int = 10) -> FloatArray:
        """Return the lowest natural frequencies (k,) [Hz]; zero-energy motions are at exactly 0.

        The DOFs and their coordinates may be unknown, unlike for `model` and `solve_modes`.

        Parameters
        ----------
        count : int
            Number of frequencies, at most 60. It includes those at zero. Small matrices have fewer.

        Raises
        ------
        ModelError
            When M is missing, a matrix is not symmetric, or K is not positive semidefinite.
        SolverError
            When the residuals are too large. Also when frequencies are missing, which a Sturm
            count shows (it counts eigenvalues below a limit by a factorisation of K).

        Examples
        --------
        >>> FEMatrices([[5, -5], [-5, 5]], [[1, 0], [0, 2]]).frequencies().round(4)
        array([0.    , 0.4359])
        """
        number = whole(count, "count", minimum=1, maximum=MOST)
        if self.M is None:
            raise ModelError(
                "the frequencies need M, which is missing. Read the mass matrix too: mass=."
            )
        K, M = (symmetric_matrix(A, name, self.n_dof) for name, A in (("K", self.K), ("M", self.M)))
        written = 0.0 if self.digits is None else 10.0**-self.digits
        return natural_frequencies(K, M, number, rounding=written)

    def model(
        self, *, massless: str = "refuse", free: bool = False, name: str | None = None
    ) -> FEModel:
        """Return an FEModel of these matrices.

        Parameters
        ----------
        massless : "refuse" or "condense"
            Treatment of DOFs without mass. "refuse" raises an error. "condense" removes these DOFs
            s statically from the others m, ``K = K_mm - K_ms K_ss^-1 K_sm``. This is exact, since
            the DOFs s have no inertia.
        free : bool
            Whether to free rigid-body motions that are held only because K lost digits (text,
            single precision), as `freed` does.
        name : str, optional
            Name of the model, as it is printed.

        Raises
        ------
        ModelError
            When M is missing or singular, or the DOFs are not known. When the structure can move
            freely and its coordinates are not known. When DOFs have no mass and `massless` is
            "refuse". When `free` is True although the structure is held by its stiffness.

        Warns
        -----
        FlexplantWarning
            When K has so few digits (text or single precision) that its rounding makes the first
            elastic eigenvalue inaccurate or holds rigid-body motions.
        """
        one_of(massless, "massless", ("refuse", "condense"))
        if self.M is None:
            raise ModelError(
                "the model needs M, which is missing. Read or export the mass matrix too."
            )
        if self.dofs is None:
            raise ModelError(
                f"it is not known what the {self.n_dof} rows stand for: nodes, directions, "
                "coordinates. with_dofs(DofSet(nodes, directions, xyz)) gives it, or dofs= of "
                "read_model. Frequencies need none of it: frequencies(10) of these matrices."
            )
        if are_swapped(self.K, self.M, self.dofs):
            raise ModelError(
                "K and M are swapped? M gives rigid translations no inertia, as a stiffness gives "
                "them no force, and K resists them as a mass does. The order is "
                "fx.structure.FEMatrices(K, M), but FEModel(M, K)."
            )
        ready = self
        if flag(free, "free"):
            digits = self.digits or (shown_digits(self.K, self.dofs) if self.located else None)
            if digits is not None or not self.located:
                ready = ready.replace(digits=digits).freed()
        K, M, D, rows, done = inertial(
            ready.K, ready.M, ready.D, ready.names, digits=self.digits, massless=massless
        )
        if done:
            dofs, notes = self.dofs._taken(rows), (*ready.notes, *done)
            ready = ready.replace(K=K, M=M, D=D, dofs=dofs, notes=notes)
        # with few digits, the last digit decides whether K is singular
        rounding = 1e-14 if self.digits is None else 10.0**-self.digits
        if not self.located and not is_positive_definite(ready.K, -rounding):
            raise ModelError(
                "the structure is free to move, but its coordinates and therefore its rigid-body "
                "rotations are not known. Give coordinates: located_at(nodes, xyz), or to the "
                "reader."
            )
        instance(name, str | None, "name", "Pass a text.")
        parts: Any = ready
        try:
            model = FEModel(parts.M, parts.K, parts.D, dofs=parts.dofs, name=name or self.source)
        except ModelError as error:
            held = None if free else ready._held_by_rounding(None)
            raise ModelError(f"{error} {held[0].upper()}{held[1:]}") if held else error from None
        if self.loss_factor:
            warn(f"{self.source or 'K'}: {_modal_damping_note(self.loss_factor)}")
        if self.digits is not None:
            held = None if free else ready._held_by_rounding(model)
            if held and model.n_unstable and not is_positive_definite(model.K, SAME):
                raise ModelError(f"K is not positive semi-definite. {held[0].upper()}{held[1:]}")
            # where the entries show no more digits than are stated, the model has said so
            shown = digits_of(K)
            said_already = shown is not None and shown <= self.digits
            found = () if said_already else (endangered(ready.K, ready.M, self.digits), held)
            for said in filter(None, found):
                warn(f"{self.source or 'K'}: {said}")
        return model

    def freed(self) -> FEMatrices:
        """Return the matrices without the stiffness that rounding of K gives to rigid-body motions.

        The new stiffness is ``K' = P^T K P`` with ``P = I - R R^T M``, where R holds the rigid-body
        motions. The elastic modes are M-orthogonal to R and do not change. Use this method for
        matrices from text files or in single precision. K becomes a full matrix.

        Raises
        ------
        ModelError
            When M or the coordinates are missing, no motion is nearly free, or n is too large.
        """
        if self.M is None or self.dofs is None or not self.located:
            raise ModelError(
                "freeing needs M and located DOFs: with_dofs(dofs) or located_at(nodes, xyz) first."
            )
        K = freed(self.K, self.M, self.dofs, self.digits)
        return self.replace(K=K, notes=(*self.notes, "K freed of rounding in rigid-body motions"))

    def _held_by_rounding(self, model: FEModel | None) -> str | None:
        """Return a text when only rounding holds rigid-body motions."""
        if self.digits is None or self.dofs is None or not self.located:
            return None
        known = None if model is None else model.rigid_body
        return held_by_rounding(self.K, self.M, self.dofs, self.digits, known)


def cosines(dofs: DofSet, rotations: Any) -> Any:
    """Return C (n, n), sparse, ``q_local = C q_global``, from {node: (3, 3) direction cosines}."""
    rows, columns, values = [np.arange(len(dofs))], [np.arange(len(dofs))], [np.ones(len(dofs))]
    instance(rotations, Mapping, "rotations", "Pass {node: (3, 3) cosines}.", LabelError)
    for node, given in rotations.items():
        matrix = real_array(given, f"rotations[{node}]", (3, 3))
        if np.abs(matrix @ matrix.T - np.eye(3)).max() > TYPED:
            raise ModelError(
                f"the direction cosines of node {node} are not orthogonal, got "
                f"{matrix.round(6).tolist()}: row i holds the global components of local axis i."
            )
        found = np.flatnonzero(dofs.nodes == node)
        if not found.size:
            raise LabelError(f"rotations name node {node}, which has no DOF: {dofs!r}.")
        for first in (0, 3):
            kinds = dofs.kinds[found]
            three = found[(kinds >= first) & (kinds < first + 3)]
            if three.size not in (0, 3):
                raise ModelError(
                    f"node {node} has a local coordinate system, but only {three.size} of three "
                    "directions: the held one would be oblique in global directions. Leave its "
                    "DOFs local, place ports elsewhere, or export it unconstrained."
                )
            three = three[np.argsort(dofs.kinds[three])]
            if three.size:
                rows.append(np.repeat(three, 3))
                columns.append(np.tile(three, 3))
                values.append((matrix - np.eye(3)).ravel())
    entries = (np.concatenate(values), (np.concatenate(rows), np.concatenate(columns)))
    return sp.csc_array(entries, shape=(len(dofs), len(dofs)))


def completed(given: Any, name: str) -> tuple[sp.csc_array, str | None]:
    """Return a symmetric matrix from one or both triangles of a file, and a note."""
    # a matrix that stores every pair (i, j), (j, i) at most once, in either triangle, is completed;
    # one that stores both is left as it is, for `check` to compare them
    if np.iscomplexobj(given):
        (real, note), (imaginary, _) = completed(given.real, name), completed(given.imag, name)
        return sp.csc_array(real + 1j * imaginary), note
    matrix = square(given, name)
    lower: Any = sp.tril(matrix, -1, format="csc")
    upper: Any = sp.triu(matrix, 1, format="csc")
    if not lower.nnz and not upper.nnz:
        return matrix, None
    pattern = [abs(part).astype(bool).astype(np.int8) for part in (lower, upper.T)]
    if pattern[0].multiply(pattern[1]).nnz:
        return matrix, None
    half: Any = lower + upper
    which = "each pair once" if lower.nnz and upper.nnz else None
    which = which or ("upper triangle only" if upper.nnz else "lower triangle only")
    full: Any = sp.csc_array(half + half.T + sp.diags_array(matrix.diagonal()))
    return full, f"{name}: {which}, completed"


def _loss_factor(K: sp.csc_array, H: sp.csc_array) -> float:
    """Return the mean of the loss factors of the rows of ``K + i H``."""
    stiff, loss = K.diagonal(), H.diagonal()
    there = stiff > 0
    return float(np.mean(loss[there] / stiff[there])) if there.any() else 0.0


def _modal_damping_note(eta: float) -> str:
    return (
        f"K is complex: its loss factor of {eta:.4g} is read as a modal damping ratio of "
        f"{eta / 2:.4g}. Pass damping=fx.ModalDamping({eta / 2:.4g}) to solve_modes"
    )
