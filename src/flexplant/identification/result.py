"""The answer of an identification: scaled shapes, and the covariance of its poles."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import scipy.linalg as la

from ..errors import SolverError
from ..lti.frequency import Frf
from ..values import ComplexArray, FloatArray
from .diagram import StabilisationDiagram
from .identified import IdentifiedModes
from .leakage import no_pole
from .line_weights import PreparedLines
from .pole_test import freedom
from .refine import Fit, Lines


def answer(
    frf: Frf,
    ready: PreparedLines,
    lines: Lines,
    fit: Fit,
    band: tuple[float, float],
    labels: Mapping[str, str],
    diagram: StabilisationDiagram | None,
) -> IdentifiedModes:
    """Return the identified modes of a fit, sorted, those inside the band."""
    misfit = fit.cost / freedom(lines, fit.poles.size)
    covariance = _covariance(fit, ready) * max(1.0, misfit)
    shapes, part, terms = fit.shapes, fit.participation, fit.terms
    if ready.swapped:
        shapes, part, terms = part, shapes, terms.transpose(1, 0, 2)
    outputs = tuple(labels.get(name, name) for name in frf.outputs)
    inputs = tuple(labels.get(name, name) for name in frf.inputs)
    shared = [(outputs.index(dof), i) for i, dof in enumerate(inputs) if dof in outputs]
    raw, unscaled = shapes, part
    shapes, part, normalised = _scaled(fit.poles, shapes, part, shared if labels else [])
    spread = _channel_covariance(fit, ready) * max(1.0, misfit)
    if ready.swapped:
        turned = np.roll(np.arange(spread.shape[1]), -len(fit.shape_maps))
        spread = spread[:, turned][:, :, turned]
    T = _scale_errors((raw, unscaled), (shapes, part), shared if normalised else [])
    spread = T @ spread @ T.conj().transpose(0, 2, 1)
    freq = np.abs(fit.poles) / (2 * np.pi)
    order = np.argsort(freq, kind="stable")
    inside = np.array([k for k in order if band[0] <= freq[k] <= band[1]], dtype=np.int64)
    outside = np.array([k for k in order if not band[0] <= freq[k] <= band[1]], dtype=np.int64)
    if not inside.size:
        lost = SolverError(
            f"the fit moved every pole out of the band {band[0]:.4g} to {band[1]:.4g} Hz. Widen it."
        )
        raise no_pole(frf, lost)
    both = np.concatenate([inside, inside + fit.poles.size])
    return IdentifiedModes(
        fit.poles[inside],
        covariance=covariance[np.ix_(both, both)],
        shapes=shapes[:, inside],
        dofs=outputs,
        participation=part[:, inside],
        inputs=tuple(frf.inputs),
        input_dofs=inputs,
        outputs=tuple(frf.outputs),
        terms=terms,
        lower=lines.lower,
        top=float(lines.freq[-1]),
        hold=lines.hold,
        segment=lines.segment,
        unreported=(fit.poles[outside], shapes[:, outside], part[:, outside]),
        mass_normalised=normalised,
        misfit=misfit,
        diagram=diagram,
        channel_covariance=spread[inside],
    )


def _covariance(fit: Fit, ready: PreparedLines) -> FloatArray:
    """Return the covariance of [Re lambda; Im lambda] of all poles."""
    size = np.sqrt(np.maximum(np.diag(fit.N), 1e-300))
    # participation of repeated poles is known up to a rotation only: it gets no variance
    inverse = la.pinvh(fit.N / np.outer(size, size), rtol=1e-13) / np.outer(size, size)
    both = 2 * fit.poles.size
    if ready.independent:
        chosen = inverse[:both, :both]
    else:
        slopes = [np.einsum("ifp,qp->ifq", J, inverse[:both]) for J in fit.jacobian]
        chosen = np.zeros((both, both))
        for a, J in enumerate(slopes):
            for b, other in enumerate(slopes):
                chosen += _inner(J, ready.spread(a, b, other))
    return np.asarray((chosen + chosen.T) / 2)


def _channel_covariance(fit: Fit, ready: PreparedLines) -> ComplexArray:
    r"""Return E[n n^H] of the errors n (n_out + n_in,) of each mode's shape and participation.

    With poles and participation theta, the error of the shape at output a is
    ``S_a d theta + D_a^T e_a``, ``d theta = N^{-1} sum_b J_b^T e_b``; D_a and J_a are orthogonal,
    so that the two are independent unless outputs share errors. Noise that acts on the machine
    is shared: near a resonance it moves all outputs along the shape, which is scale.
    """
    m, n_out, n_in = fit.poles.size, len(fit.shape_maps), fit.participation.shape[0]
    size = np.sqrt(np.maximum(np.diag(fit.N), 1e-300))
    inverse = la.pinvh(fit.N / np.outer(size, size), rtol=1e-13) / np.outer(size, size)
    slopes = np.array([slope for slope, _ in fit.shape_maps]).reshape(n_out, 2, m, -1)
    direct = [own for _, own in fit.shape_maps]
    common, mixed = inverse, np.zeros((n_out, inverse.shape[0], 2 * m))
    held = np.zeros((n_out, n_out, 2 * m, 2 * m))
    if ready.independent:
        for a, own in enumerate(direct):
            held[a, a] = _inner(own, own)
    else:
        gains = [np.einsum("ifp,qp->ifq", J, inverse) for J in fit.jacobian]
        common = np.zeros_like(inverse)
        for a in range(n_out):
            for b in range(n_out):
                other = ready.spread(a, b, direct[b])
                common = common + _inner(gains[a], ready.spread(a, b, gains[b]))
                mixed[b] += _inner(gains[a], other)
                held[a, b] = _inner(direct[a], other)
    slopes = np.concatenate([slopes, _free_entries(fit)])
    mixed = mixed.reshape(n_out, -1, 2, m)
    held = held.reshape(n_out, n_out, 2, m, 2, m)
    found = np.zeros((m, n_out + n_in, n_out + n_in), dtype=np.complex128)
    for k in range(m):
        slope = slopes[:, :, k]
        S = np.einsum("oap,pq,ebq->oaeb", slope, common, slope, optimize=True)
        cross = np.einsum("oap,epb->oaeb", slope, mixed[..., k])
        S[:, :, :n_out] += cross
        S[:n_out] += cross.transpose(2, 3, 0, 1)
        S[:n_out, :, :n_out] += held[:, :, :, k, :, k].transpose(0, 2, 1, 3)
        found[k] = S[:, 0, :, 0] + S[:, 1, :, 1] + 1j * (S[:, 1, :, 0] - S[:, 0, :, 1])
    return np.asarray((found + found.conj().transpose(0, 2, 1)) / 2)


def _free_entries(fit: Fit) -> FloatArray:
    """Return the derivatives (n_in, 2, m, n_parameters) of Re and Im of the participation."""
    n_in, m = fit.participation.shape
    found = np.zeros((n_in, 2, m, 2 * m * n_in))
    for k, pivot in enumerate(fit.pivots.tolist()):
        free = [i for i in range(n_in) if i != pivot]
        for j, i in enumerate(free):
            found[i, 0, k, (2 + 2 * j) * m + k] = found[i, 1, k, (3 + 2 * j) * m + k] = 1.0
    return found


def _scale_errors(
    raw: tuple[ComplexArray, ComplexArray],
    scaled: tuple[ComplexArray, ComplexArray],
    shared: list[tuple[int, int]],
) -> ComplexArray:
    r"""Return T (m, n_out + n_in, n_out + n_in) from errors of raw channels to those scaled.

    With ``phi = f psi`` and ``p = l / f``: ``d phi = f d psi + phi df/f`` and
    ``d p = d l / f - p df/f``. Of `shared` channels s, ``f^2 ~ psi_s^H l_s / |psi_s|^2`` and l_s is
    a multiple r of psi_s but for noise, so that ``2 df/f = psi_s^H (d l_s / r - d psi_s) /
    |psi_s|^2``; else ``f = 1 / psi_max``.
    """
    psi, part = raw
    n_out, m = psi.shape
    large, columns = np.argmax(np.abs(psi), axis=0), np.arange(m)
    factor = scaled[0][large, columns] / psi[large, columns]
    g = np.zeros((m, n_out + part.shape[0]), dtype=np.complex128)
    if shared:
        rows, places = (list(side) for side in zip(*shared, strict=True))
        driven = psi[rows].conj() / np.sum(np.abs(psi[rows]) ** 2, axis=0)
        ratio = np.sum(driven * part[places], axis=0)
        for row, place, weight in zip(rows, places, driven, strict=True):
            g[:, row] -= 0.5 * weight
            g[:, n_out + place] += 0.5 * weight / ratio
    else:
        g[columns, large] = -1.0 / psi[large, columns]
    T = np.concatenate([scaled[0], -scaled[1]]).T[:, :, None] * g[:, None, :]
    diagonal = np.arange(g.shape[1])
    T[:, diagonal, diagonal] += np.where(diagonal < n_out, factor[:, None], 1 / factor[:, None])
    return np.asarray(T)


def _inner(left: ComplexArray, right: ComplexArray | None) -> Any:
    """Return Re(left^H right), summed over inputs and lines; zero where right is None."""
    if right is None:
        return 0.0
    return (left.reshape(-1, left.shape[2]).conj().T @ right.reshape(-1, right.shape[2])).real


def _scaled(
    poles: ComplexArray, shapes: ComplexArray, part: ComplexArray, shared: list[tuple[int, int]]
) -> tuple[ComplexArray, ComplexArray, bool]:
    """Return shapes mass-normalised by shared DOFs, or with a largest entry of 1."""
    columns = np.arange(poles.size)
    if shared:
        rows, places = (list(side) for side in zip(*shared, strict=True))
        driven = shapes[rows]
        ratio = np.sum(driven.conj() * part[places], axis=0) / np.sum(np.abs(driven) ** 2, axis=0)
        factor = np.sqrt(2j * poles.imag * ratio)
        large = np.argmax(np.abs(shapes), axis=0)
        factor = factor * np.where((factor * shapes[large, columns]).real < 0, -1.0, 1.0)
    else:
        factor = 1.0 / shapes[np.argmax(np.abs(shapes), axis=0), columns]
    return shapes * factor, part / factor, bool(shared)
