r"""How the main verbs work: what is computed, in which order, and what decides.

Their own pages say how to use them.

**identify_modes.** The poles that stay over the orders of a stabilisation diagram are the first
answer, with the shapes and residual terms of least squares. They start a maximum likelihood fit
(`refine`) of

.. math:: H(s) = \sum_k \frac{\psi_k l_k^T}{s - \lambda_k} +
    \frac{\bar\psi_k \bar l_k^T}{s - \bar\lambda_k}
    + \sum_{p=1}^{lower} \frac{E_{-p}}{s^p} + \sum_{p=0}^{upper-1} E_p s^p

with residues of rank one, so that close and repeated modes are distinguished by several inputs
and outputs. Rigid-body modes and modes below the band are in 1/s and 1/s^2, those above in the
powers of s. Chosen poles that noise alone would produce once in 1000 times are left out; where
more than noise is left a pole is added. With `start` neither is done. What then is still not
explained is warned of, with its frequency. A pole with another at the same place (repeated, or
too close for the diagram) is taken apart where that lowers chi-square by more than noise does.

Measurements that no linear machine explains: a pole is added only for what the outputs share,
beyond separate poles at each of them, and misfit that is correlated over neighbouring lines
counts as so much less. Of two poles within a bandwidth with the same shape and participation one
remains. Where outputs (inputs, runs) disagree on the poles, they are warned of: poles are then
means of each output's own, with the deviations of random effects. Poles whose deviation of
frequency or damping exceeds it, mains multiples narrower than half a line and poles at the edge
of the band are not reported, but listed with the reason in `rejected`. So are lines at multiples
of 50 and 60 Hz that stand out of what their neighbours predict, in some outputs or all: these are
left out before the diagram.

Lines of Hann-windowed segments show a resonance widened by the window: where that explains them
better (H1 of random excitation), each term ``1/(s - lambda)`` is fitted as such lines show it, so
that damping is that of the machine down to resonances of half a line.

**localise.** All candidates are screened together, each alone, by linearisation (one rank-one
change each, in one product); the best `screen` of them are fitted. Then subsets of up to `most`
candidates grow: all candidates are screened again on what the best subsets leave, all pairs to
first order, and members are exchanged while that helps; a candidate that explains, to first
order, less than a quarter of what would lower the criterion does not join. Where modes are
compared and candidates are of low rank (masses, springs, dampers), each fit is made in few
coordinates, the modes of the band and how the others follow the candidate's force, with its error
corrected to second order; the chosen subset is fitted again in all. The least extended Bayesian
information criterion ``chi^2 + k ln n + 2 ln C(c, k)`` (``n ln(e/n)`` for ``chi^2`` where the
noise is not known) chooses; its last term counts in how many ways k of c places can be chosen, so
that c places without a change name none. To find what stands out, give more data than `most`
unknowns.

What is wrong everywhere (Young's modulus, damping) hides what is wrong in one place: as
`nuisance` it is fitted anew with every candidate and with none at all, so that a candidate is
scored by what only it explains: ``(J_c^T r)^2 / (J_c^T J_c)`` with r and J_c free of what the
nuisance explains, before the exact fits.

**update.** With eigenvalues alone, without bounds and priors: the paper's (13) and (14),
Gauss-Newton with real unknowns in complex equations::

    Re[S^H W S] dp = Re[S^H W d lambda],    p <- p + dp

Otherwise ``1/2 |r(p)|^2 + 1/2 |(p - mean)/std|^2``, r the whitened residuals of all kinds, in a
trust region within the bounds. The second term, of the parameters with a prior, takes part where
the noise of every residual is known (the answer is then the maximum a posteriori).

Modes are found by their number in the model at `start` and followed by shape (see
`flexplant.updating.family`), so they may swap order on the way; those with measured shapes
are assigned by MAC at each step. Modes that are exactly repeated there are first turned to the
vectors in which the step splits them, the lower mode number going to the lower frequency. Steps
are shortened while M or K would become indefinite, a measured mode would cease to oscillate, or
the error (12) would grow.

**design_hinf.** The plant is prepared (scaled, balanced; a sampled one is mapped to continuous
time with its norms kept), solved by the method, and the controller is brought back to the user's
channels and units. It is then judged by its own closed loop: stability, and the norm by two
routes.

**tune_loops.** Each axis gets ``k (1 + w_i / s) (1 + a s / w_b) / (1 + s / (b w_b)) F(s)`` with a
low-pass and notches in F. w_b, where the loop of the rigid body alone crosses 1, is made as large
as ``|1 + L| >= 1 / peak`` allows, beyond resonances too; a, b, the corner of the low-pass and
frequency, depth and width of the notches are found on the way, from many starts: the best of
them, without proof that no other law does better. w_i is w_b / 10, no zero lies below it, no
corner above 0.45 of the rate or the last line.

Where the laws found for each axis alone do not hold the peak together, those of all axes are
changed together until they do, for the highest geometric mean of their bandwidths: |S| of each
axis with the others closed, and the largest singular value of S at u and of S at y, where the
channels of a side have one unit; with the truncated modes too, where these are known. Laws that
come closest to the peak are returned with a warning that says what ended the search.

No model is needed: the plant may be an Frf. A line is taken to lie anywhere within two standard
deviations, by its variance, else its coherence (averages by `freedom`; unless given as if of
two), else by how lines scatter. Where a resonance turns between two lines, the circle through its
neighbours is followed; where lines do not resolve it, the loop gain has to be small there. Peaks
that fall between two lines unseen are not known: the lines have to be closer than a mode is wide.
Above the last line the plant is unknown, and the loop gain there at most 0.1.

**stage_weights.** With Y = G_yu T of the decoupled axes at sigma = 2 pi f_c of the real axis,
f_c being 1.6 times the bandwidth, axis i is multiplied by d_i = rms(Y_i) / rms(Y_1), actuator j
has the size f0_j = (m / r)^(1/2) |(T / d)_j| (m actuators, r axes), and a sensor the noise that it
shows of a unit of all axes. In these units the blocks are

.. math:: \begin{bmatrix} W_S S & W_S P W_d \\ W_u K S & W_u K P W_d \end{bmatrix}

with 1/W_S rising as f/f_c up to `peak`, W_u letting the efforts roll off from 6 f_c, and W_d =
`disturbance` f0 at the actuators (a hundredth of it elsewhere, where actuators have noise). Where
the disturbances of w and the noise of actuators leave an axis at rest, every actuator gets a
disturbance. Sensors of velocity (acceleration) do not show where the machine rests: W_S then has a
high-pass of first (second) order at f_c. Where a sensor is the axis of a free motion that no POI
shows, z contains its signal without noise (`y1:signal`), so that it is held at zero. K P W_d is the
complementary sensitivity T at u, and the weights of z are divided by ``peak disturbance effort``,
so that gamma = 1 requires |T| < peak at u: with the default ratios
this block decides, and gamma is how far the loop is from it. The controller lists what each block
reaches (`Controller.reached`).

**design_kalman.** The noise model is that of `simulate`: `plant.process_noise` per sample into x
and `plant.sensor_noise` on a sample of y; delays of u are known exactly. The Riccati equation is
solved scaled inside, in any units (`flexplant.lti.filter_dare`), and in square roots where noise is
so little that P has too few digits ([Hewer1971]_, by QR factors). Truncated modes add no states.
Their motion under the disturbances is noise with covariances R_t at the sensors, V_t at the POIs
and N_t between them, and they follow u by their static compliance::

    S = C2 P C2' + R + R_t,   L = P C2' S^-1,   L_z = (C1 P C2' + N_t) S^-1

with P of the Riccati equation of (A, C2, Q, R + R_t). Without any delay of u the static compliance
is left out: it would close an algebraic loop from y to u to y.
"""
