"""Measured modes as the modes of a structure: a plant without a finite-element model."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import scipy.linalg as la

from ..arrays import ComplexArray, FloatArray, IntArray, divisor, flag, instance, whole
from ..certificates import Certificate, Verified
from ..errors import LabelError, ModelError, counted, warn
from ..labels import DofSet
from ..modes import Modes
from ..structure import interpolated
from ..structure.rigid import rigid_motions
from ..tolerances import NEGLIGIBLE
from .result import IdentifiedModes

#: fraction of the largest eigenvalue of an inertia or a flexibility below which a negative
#: eigenvalue counts as noise
NEGATIVE = 0.05
#: relative imaginary part of a shape, and relative error of its expansion in modes of a model,
#: above which a warning is given
MISSED_SHAPE = 0.1
#: relative error of the real shapes of a pole outside the band below which it counts as a mode
ALIKE = 0.3
#: frequencies of residual vectors that are tried, relative to the upper end of the band
NEAREST, FARTHEST = 1.03, 10.0


def structural_modes(
    measured: IdentifiedModes, dofs: DofSet, *, over: Modes | None = None, rigid: bool = True
) -> Modes:
    r"""Return identified modes as modes of a structure for `assemble_plant`.

    `IdentifiedModes` describes the fit
    :math:`H = \sum_k \psi_k l_k^T/(s - \lambda_k) + \ldots + E(s)`. Its shapes are mass-normalised
    at a place where the machine was both driven and measured. The modes of the structure have three
    parts:

    - Elastic modes with the identified poles. Their shapes are
      :math:`\phi_k = \mathrm{Re}\,\psi_k` at the outputs and
      :math:`\mathrm{Re}(2 i\,\mathrm{Im}(\lambda_k)\, l_k)` at the inputs. At a place that is both
      output and input, the mean of the two is used.
    - Rigid-body modes and residual vectors, which represent the remainder E(s). In the band, E(s)
      is approximated by :math:`A/s^2 + G\,\omega_v^2/(s^2 + \omega_v^2)`. The rigid-body modes
      satisfy :math:`\Phi_r \Phi_r^T = A` and are combinations of the rigid-body motions of the
      geometry. The residual vectors v satisfy :math:`\sum v v^T/\omega_v^2 = G`. Their frequency
      :math:`\omega_v` lies above the band. The index c denotes the places that were both driven and
      measured, and o the other places. The vectors are found from the entries of G with at
      least one index c. Between two places o, they give :math:`G_{oo} = G_{oc} G_{cc}^{-1} G_{co}`.
    - Modes just outside the band. They become residual vectors with their own frequency and damping
      if they can be modes of a structure. For this, their shapes must be real, and the shapes at
      inputs and outputs must agree.

    Parameters
    ----------
    measured : IdentifiedModes
        Result of `identify_modes(frf, dofs={channel: label})`.
    dofs : DofSet
        DOFs of the labels. Points of interest at other places need an interpolation between them,
        for example ``interpolated(DofSet(...))``.
    over : Modes, optional
        Modes of a model of the same structure, at most as many as measured places. The measured
        shapes psi are expanded to all DOFs of the model by ``phi = Phi Phi_a^+ psi``. Phi holds the
        shapes of the model at all its DOFs, Phi_a those at the measured DOFs, and ^+ denotes the
        pseudo-inverse. This is SEREP, the system equivalent reduction expansion process. Points of
        interest may then be anywhere on the model.
    rigid : bool
        Whether the term in 1/s^2 represents rigid-body modes. False: the structure is held.

    Returns
    -------
    Modes
        Modes of the structure, rigid-body modes first. The entry "imaginary" of `certificate` is
        the size of the neglected imaginary parts. With `over`, the measured shapes are fitted by
        combinations of the model's shapes. The entry "expansion" is the relative error of this fit.
        A warning is given if this error is above 0.1. ``plant.uncertain(numbered(measured,
        modes))`` passes the covariance of the poles to the plant. A further argument passes the
        covariance of the shapes, ``Shapes(shape_deviations(measured, dofs), measured.modes)``.

    Raises
    ------
    ModelError, LabelError
        When the scale of shapes is not known, `over` has more modes than there are measured places,
        or a channel is not in `dofs`. Also when the term in 1/s^2 does not belong to a body with
        positive inertia.

    References
    ----------
    [OCallahan1989b]_.

    Examples
    --------
    The frequency responses of a chain give its modes:

    >>> import flexplant as fx
    >>> import numpy as np
    >>> model = fx.chain(masses=[1.0, 1.0], stiffnesses=[4e5], ground=[1e5, 0.0])
    >>> modes = fx.solve_modes(model, count=2, damping=fx.ModalDamping(0.01))
    >>> sensors = [fx.Sensor(f"y{i}", at=f"{i}:x") for i in (1, 2)]
    >>> plant = fx.assemble_plant(modes, fx.Ports(u=[fx.Actuator("u1", at="1:x")], y=sensors))
    >>> frf = fx.frequency_response(plant.Gyu, np.linspace(10.0, 250.0, 400))
    >>> measured = fx.identify_modes(frf, dofs={"y1": "1:x", "y2": "2:x", "u1": "1:x"})
    >>> found = fx.identification.structural_modes(measured, model.dofs, rigid=False)
    >>> found.freq.round(1)
    array([ 34.5, 147. ])
    """
    at, dofs, rows = measured_places(measured, dofs, over)
    free, labels = flag(rigid, "rigid"), at.labels
    shapes = at.shapes()
    imaginary = float(np.max(_imaginary(shapes)))
    outside = at.outside()
    A, G, fast = at.smooth(outside)
    body = at.rigid(A, dofs, rows) if free else np.zeros((len(labels), 0))
    residual = at.residual(G, fast)
    certificate = Certificate((Verified("imaginary", imaginary, "parts of the shapes"),))
    columns = [body, shapes.real, np.hstack([outside.shapes.real, residual])]
    place = dofs
    if over is not None:
        E = expansion(over, rows)
        left = np.linalg.norm(columns[1] - E[rows] @ columns[1], axis=0)
        worst = float(np.max(left / np.linalg.norm(columns[1], axis=0)))
        check = Verified("expansion", worst, "least squares of the shapes", MISSED_SHAPE)
        certificate = certificate.extended(check)
        columns = [E @ one for one in columns]
    else:
        place = dofs.select(labels)
        if dofs.interpolation is not None:
            # between the places that were measured only
            margin = float(getattr(dofs.interpolation, "margin", 0.0))
            place = interpolated(place, margin=margin)
    if imaginary > MISSED_SHAPE:
        warn(
            f"a measured shape has an imaginary part of {imaginary:.0%}: the modes of this "
            "structure are real, so that it is left out. Measure longer, or look for two modes "
            "that were identified as one."
        )
    if certificate.get("expansion", 0.0) > MISSED_SHAPE:
        warn(
            f"{certificate['expansion']:.0%} of a measured shape is not in the span of the "
            "model's modes: the error of the expansion is at least this large. Give more modes "
            "of the model, or update it first."
        )
    body, phi, vectors = columns
    m = residual.shape[1]
    near = outside.poles
    zeta = np.concatenate([np.zeros(body.shape[1]), measured.zeta])
    return Modes(
        np.concatenate([np.zeros(body.shape[1]), np.abs(measured.poles)]),
        zeta,
        np.hstack([body, phi]),
        place,
        n_rigid=body.shape[1],
        vectors=vectors,
        vector_omega=np.append(np.abs(near), np.full(m, fast)),
        vector_zeta=np.append(
            -near.real / np.abs(near), np.full(m, float(np.median(measured.zeta)))
        ),
        vector_dofs=[
            *(f"mode outside the band at {abs(pole) / (2 * np.pi):.5g} Hz" for pole in near),
            *(f"residual {i + 1}" for i in range(m)),
        ],
        certificate=certificate,
    )


def measured_places(
    measured: Any, dofs: Any, over: Modes | None
) -> tuple[MeasuredPlaces, DofSet, IntArray]:
    """Return the places of an identification's channels, the DOFs and their rows among these."""
    instance(measured, IdentifiedModes, "measured", "Pass the answer of identify_modes(frf).")
    instance(dofs, DofSet, "dofs", "Pass DofSet(nodes, directions, xyz), or model.dofs.")
    if over is not None:
        instance(over, Modes, "over", "Pass solve_modes(model, count=...).")
        dofs = over.dofs
    if not measured.mass_normalised:
        raise ModelError(
            "the scale of these shapes is not known: no input and output are at one DOF. Drive "
            "and measure one place, and name it in identify_modes(frf, dofs={channel: label})."
        )
    labels = tuple(dict.fromkeys([*(measured.dofs or ()), *measured.input_dofs]))
    absent = [label for label in labels if label not in dofs.labels]
    if absent:
        raise LabelError(
            f"{', '.join(absent[:4])} are channels without a DOF in {dofs!r}. Give their places: "
            "identify_modes(frf, dofs={channel: label})."
        )
    return MeasuredPlaces(measured, labels), dofs, dofs.indices(labels)


class OutsideBand(NamedTuple):
    """Modes just outside the band, from the fit and by places."""

    poles: ComplexArray
    residues: ComplexArray
    shapes: ComplexArray


class MeasuredPlaces:
    """The channels of an identification, sorted by their places."""

    def __init__(self, measured: IdentifiedModes, labels: tuple[str, ...]) -> None:
        self.measured, self.labels, self.count = measured, labels, len(labels)
        #: positions among the places
        self.outputs = [labels.index(label) for label in measured.dofs or ()]
        self.inputs = [labels.index(label) for label in measured.input_dofs]
        self.top = 2 * np.pi * measured.top

    def maps(self, poles: ComplexArray) -> ComplexArray:
        """Return the maps (m, places, n_out + n_in) from [shape; participation] to a shape."""
        # the mean of both where a place was driven and measured
        found = np.zeros((poles.size, self.count, len(self.outputs) + len(self.inputs)), complex)
        for channel, place in enumerate([*self.outputs, *self.inputs]):
            found[:, place, channel] = 1.0 if channel < len(self.outputs) else 2j * poles.imag
        times = np.bincount([*self.outputs, *self.inputs], minlength=self.count)
        return np.asarray(found / times[:, None])

    def shapes(self) -> ComplexArray:
        """Return the shapes (places, m)."""
        measured = self.measured
        return self._at(measured.poles, np.asarray(measured.shapes), measured.participation)

    def _at(self, poles: ComplexArray, shapes: Any, part: Any) -> ComplexArray:
        channels = np.concatenate([shapes, part]).T[:, :, None]
        found = np.matmul(self.maps(poles), channels)[:, :, 0].T
        return np.asarray(found, dtype=np.complex128)

    def outside(self) -> OutsideBand:
        """Return the poles outside the band that are modes of a structure."""
        poles, shapes, part = self.measured.unreported
        phi = self._at(poles, shapes, part)
        made = phi[self.outputs][:, None] * phi[self.inputs] / (2j * poles.imag)
        known = shapes[:, None] * part
        off = np.linalg.norm(made.real - known.real, axis=(0, 1))
        off = np.hypot(off, np.linalg.norm(made.imag - known.imag, axis=(0, 1)))
        like = off < ALIKE * np.linalg.norm(known, axis=(0, 1))
        keep = np.flatnonzero(like & (_imaginary(phi) < ALIKE))
        return OutsideBand(poles[keep], known[:, :, keep], phi[:, keep])

    def smooth(self, outside: OutsideBand) -> tuple[FloatArray, FloatArray, float]:
        """Return A, G and w of ``A/s^2 + G w^2/(s^2 + w^2)``, nearest to all but the modes."""
        # the residual terms and the poles outside the band that are not modes of a structure, at
        # 200 frequencies of the band, relative to the whole response; w is searched
        measured, top = self.measured, self.top
        freq = np.geomspace(0.5 * float(measured.freq.min()), measured.top, 200)
        s2 = -((2 * np.pi * freq) ** 2)
        whole = measured.replace(hold=None, delay=0.0).frf(freq).data
        s = 2j * np.pi * freq
        part: ComplexArray = np.asarray(measured.shapes)[:, None, :] * measured.participation
        poles = np.concatenate([measured.poles, outside.poles])[:, None]
        part = np.concatenate([part, outside.residues], axis=2)
        modal = part @ (1 / (s - poles)) + part.conj() @ (1 / (s - poles.conj()))
        rest = np.real(whole - modal).reshape(-1, freq.size)
        weight = 1 / np.sqrt(np.mean(np.abs(whole) ** 2, axis=(0, 1)))
        best = None
        for w in top * np.geomspace(NEAREST, FARTHEST, 60):
            terms = np.array([1 / s2, w**2 / (s2 + w**2)])
            size = np.abs(terms * weight).max(axis=1, keepdims=True)
            found = np.linalg.lstsq((terms / size * weight).T, (rest * weight).T)[0] / size
            left = float(np.sum(((rest - found.T @ terms) * weight) ** 2))
            if best is None or left < best[0]:
                best = left, found.reshape(2, len(self.outputs), -1), float(w)
        assert best is not None  # noqa: S101 - 60 were tried
        return best[1][0], best[1][1], best[2]

    def rigid(self, A: FloatArray, dofs: DofSet, rows: Any) -> FloatArray:
        """Return the rigid-body modes (places, r): ``U S U^T`` nearest to A, that of 1/s^2."""
        some = dofs.select([dofs.labels[i] for i in rows])
        motions = rigid_motions(some, some.xyz.mean(axis=0))
        size = np.linalg.norm(motions, axis=0)
        # nodes on a line have no rotation about it
        U = la.orth(motions / divisor(size), rcond=1e-9)
        r = U.shape[1]
        pairs = [(i, j) for i in range(r) for j in range(i, r)]
        made = []
        for i, j in pairs:
            S = np.zeros((r, r))
            S[i, j] = S[j, i] = 1.0
            made.append((U[self.outputs] @ S @ U[self.inputs].T).ravel())
        found, *_ = np.linalg.lstsq(np.array(made).T, A.ravel())
        S = np.zeros((r, r))
        for (i, j), value in zip(pairs, found.tolist(), strict=True):
            S[i, j] = S[j, i] = value
        values, vectors = la.eigh(S)
        if not values.size or values[-1] <= 0 or values[0] < -NEGATIVE * values[-1]:
            raise ModelError(
                "the term in 1/s^2 of the measurement is not a rigid-body motion with positive "
                "mass. Pass rigid=False for a held structure; begin the band of a free one lower."
            )
        keep = values > NEGLIGIBLE * values[-1]
        return np.asarray(U @ (vectors[:, keep] * np.sqrt(values[keep])))

    def residual(self, G: FloatArray, fast: float) -> FloatArray:
        """Return residual vectors (places, m), mass-normalised at their frequency [rad/s]."""
        both = [(self.outputs.index(p), i) for i, p in enumerate(self.inputs) if p in self.outputs]
        o, i = [pair[0] for pair in both], [pair[1] for pair in both]
        block = G[np.ix_(o, i)]
        values, turn = la.eigh((block + block.T) / 2)
        keep = values > NEGLIGIBLE * np.abs(values).max(initial=0.0)
        half = turn[:, keep] / np.sqrt(values[keep])
        vectors = np.zeros((self.count, int(keep.sum())))
        vectors[self.inputs] = G[o].T @ half
        vectors[self.outputs] = G[:, i] @ half
        return vectors * fast


def _imaginary(shapes: ComplexArray) -> FloatArray:
    """Return the relative size (m,) of the shapes' imaginary parts."""
    size = np.linalg.norm(shapes, axis=0)
    return np.asarray(np.linalg.norm(shapes.imag, axis=0) / divisor(size))


def expansion(over: Modes, rows: Any) -> FloatArray:
    """Return ``Phi Phi_a^+`` (n, places) of a model's modes and the rows of measured places."""
    Phi = np.real(over.phi)
    seen = Phi[rows]
    count, places = over.n_modes, len(rows)
    if np.linalg.matrix_rank(seen / np.linalg.norm(Phi, axis=0)) < count:
        raise ModelError(
            f"{counted(places, 'measured place')} cannot determine {counted(count, 'mode')} of the "
            "model: expand over fewer, solve_modes(model, count=...), or measure at more places."
        )
    return np.asarray(np.linalg.lstsq(seen.T, Phi.T)[0].T)


def shape_deviations(
    measured: IdentifiedModes, dofs: DofSet, *, over: Modes | None = None, count: int = 2
) -> FloatArray:
    r"""Return the principal components of the errors of shapes from `structural_modes`.

    The vector n contains the error of the identified shape of a mode, followed by the error of its
    participation vector. The mode shape then has the error :math:`A n`. The matrix A takes the mean
    at places that were both driven and measured. If the modes of a model are given, A also expands
    the shape to all its DOFs. The noise is assumed circular: real and imaginary parts have the same
    variance and are not correlated. The real part of the error then has the covariance
    :math:`C = \mathrm{Re}(A\,E[n n^H] A^H)/2 = \sum_j v_j v_j^T`. The vectors v_j are the
    eigenvectors of C, scaled by the square roots of their eigenvalues. The largest v_j are kept and
    scaled so that the sum of all variances is preserved.

    Parameters
    ----------
    measured, dofs, over
        Measured modes, DOFs, and modes of a model, as for `structural_modes`.
    count : int
        Number of vectors v_j that are kept for each mode. If the noise of the sensors is
        independent, the covariance is exact only with one vector for each place.

    Returns
    -------
    (m, n, count) array
        Vectors v_j of m modes at n DOFs, for ``plant.uncertain(measured, Shapes(...))``.

    Raises
    ------
    ModelError, LabelError
        In the same cases as for `structural_modes`. Also when the covariance of the shapes is not
        known.

    Examples
    --------
    A mass on a spring has one mode and one DOF:

    >>> import flexplant as fx
    >>> import numpy as np
    >>> freq = np.linspace(10.0, 250.0, 400)
    >>> model = fx.chain(masses=[1.0], stiffnesses=[], ground=4e5)
    >>> s = 2j * np.pi * freq
    >>> H = 1 / (s**2 + 12.0 * s + 4e5)
    >>> frf = fx.Frf(freq, H[None, None], ["u1"], ["y1"], variance=1e-16 * np.ones((1, 1, 400)))
    >>> measured = fx.identify_modes(frf, dofs={"y1": "1:x", "u1": "1:x"})
    >>> fx.identification.shape_deviations(measured, model.dofs, count=1).shape
    (1, 1, 1)
    """
    at, dofs, rows = measured_places(measured, dofs, over)
    kept = whole(count, "count")
    if measured.channel_covariance is None:
        raise ModelError(
            "the covariance of these shapes is not known: identify them from an FRF, "
            "identify_modes(frf, dofs=...)."
        )
    maps = at.maps(measured.poles)
    covariance = np.real(maps @ measured.channel_covariance @ maps.conj().transpose(0, 2, 1)) / 2
    if over is not None:
        E = expansion(over, rows)
        covariance = E @ covariance @ E.T
    values, vectors = np.linalg.eigh(covariance)
    values = np.maximum(values[:, ::-1], 0.0)
    kept = min(kept, values.shape[1])
    part = values[:, :kept].sum(axis=1, keepdims=True)
    more = values.sum(axis=1, keepdims=True) / divisor(part)
    return np.asarray(vectors[:, :, ::-1][:, :, :kept] * np.sqrt(values[:, :kept] * more)[:, None])
