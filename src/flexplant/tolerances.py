"""Named tolerances, relative to the compared quantity; double precision: 2e-16."""

from __future__ import annotations

import numpy as np

#: relative distance of neighbouring numbers in double precision
PRECISION = float(np.finfo(np.float64).eps)
#: replaces zero in a divisor or a logarithm; it is not relative: no size in SI units is smaller,
#: and 1e8 times its reciprocal does not overflow
TINY = 1e-300
#: singular values below this, relative to the largest, are the rounding of some hundred rows and
#: count as zero in ranks
RANK = 1e-13
#: a number below this, relative to the terms of its sum, is the rounding of these terms
ROUNDING = 1e-12
#: eigenvalues of a scaled matrix up to this are zero: the rounding of some ten thousand rows
NULL = 1e-11
#: the residual of a solved equation, relative to its terms: the rounding of some hundred states is
#: 1e-13, and badly conditioned equations lose three digits more
RESIDUAL = 1e-10
#: half of the digits: a square, an energy or an eigenvalue that is known to rounding tells its root
#: to this
ROOT = float(np.sqrt(PRECISION))
#: the fraction of a motion that a basis or a reduced model may miss where it should hold all of it
MISSED = 1e-7
#: relative difference up to which two numbers are the same one: nine digits survive a change of
#: units and binary files. A motion, gain or direction below it is absent
SAME = 1e-9
#: relative error that no printed figure shows; single precision and files of six digits keep it
FOUR_DIGITS = 1e-4
#: a part below this fraction of the whole does not matter: no machine is known to three digits
NEGLIGIBLE = 1e-3
#: two results that differ by at most 1 % are the same to an engineer
CLOSE = 1e-2
#: probability of a false alarm: noise alone raises one in a thousand warnings
CHANCE = 1e-3
#: probability that a printed interval holds the value
INTERVAL = 0.95
#: number of standard deviations that are taken as the size of what is not known: 95 %
DEVIATIONS = 2.0
#: number of standard deviations that noise exceeds in one of 10^8 values: larger values do not come
#: from noise
CERTAIN = 6.0
#: largest number of steps of an iteration that converges: 60 bisections or doublings reach rounding
MOST_STEPS = 60
#: number of plants whose results that no controller changes are kept, for all of their loops
KEPT_PLANTS = 8
#: numbers that were typed, or printed into a file by another program, have at least six digits; no
#: model of a machine is better known, so that two ways to one figure agree to this
TYPED = 1e-6
#: a search ends when its value moves by less, relative to the value: nothing in a machine is known
#: to nine digits
SETTLED = SAME
#: poles closer than this, relative to their size, are one pole: eigenvalue solvers split a double
#: pole, as of a rigid-body mode, by the root of their rounding (1.5e-8) times its condition
SPLIT = TYPED
