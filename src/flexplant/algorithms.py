r"""How the main functions work: what they compute, in which order, and by which criteria.

The page of each function says how to use it.

**identify_modes.** The first estimate consists of the poles that stay the same over the model
orders of a stabilisation diagram. Their shapes and the residual terms follow from least squares.
From there a maximum likelihood fit (`refine`) starts, with the model

.. math:: H(s) = \sum_k \frac{\psi_k l_k^T}{s - \lambda_k} +
    \frac{\bar\psi_k \bar l_k^T}{s - \bar\lambda_k}
    + \sum_{p=1}^{lower} \frac{E_{-p}}{s^p} + \sum_{p=0}^{upper-1} E_p s^p

The residues have rank one, so that close and repeated modes are distinguished by several inputs and
outputs. The terms in 1/s and 1/s^2 represent rigid-body modes and modes below the band, and the
powers of s represent modes above the band. Poles that are not significant (noise alone would
produce them more than once in 1000 times) are left out. If the remaining misfit is larger than
noise, a pole is added. With `start`, poles are neither left out nor added. A warning names the
frequency of a misfit that is still not explained. A pole is split into two (repeated modes, or
modes that are too close for the diagram) if this lowers chi-square by more than noise would.

Some measurements cannot be explained by any linear machine. A pole is therefore added only for a
misfit that the outputs have in common and that separate poles at each output do not explain. A
misfit that is correlated over neighbouring frequency lines has less weight, according to this
correlation. If two poles with the same shape and participation are closer than their bandwidth, one
of them is removed. If outputs (or inputs, or runs) disagree on the poles, there is a warning. The
poles are then means of the poles of the single outputs, with standard deviations of a
random-effects model. Some poles are not reported, but listed with the reason in `rejected`. These
are poles whose standard deviation of frequency or damping is larger than the value itself, poles at
multiples of the mains frequency that are narrower than half a line, and poles at the edge of the
band. Lines at multiples of 50 and 60 Hz are listed there too, if they differ from what their
neighbours predict in some or all outputs. These lines are left out before the diagram is computed.

The window widens a resonance in the lines of Hann-windowed segments. If this explains the lines
better (H1 estimates with random excitation), each term ``1/(s - lambda)`` is fitted as it appears
in such lines. The damping is then that of the machine, down to resonances as narrow as half a line.

**localise.** First all candidates are screened, each one separately. The effect of a candidate is
linearised: it is a rank-one change, and one product gives the effects of all. The best `screen`
candidates are fitted. Then subsets of up to `most` candidates grow. In each step all candidates are
screened again on the misfit that the best subsets leave, all pairs are tried to first order, and
members are exchanged as long as this helps. A candidate does not join if, to first order, it
explains less than a quarter of the decrease that would lower the criterion. If modes are compared
and the candidates have low rank (masses, springs, dampers), each fit uses few coordinates: the
modes of the band and the deformation under the candidate's force. Its error is corrected to second
order, and the chosen subset is fitted again in all coordinates. The subset with the least extended
Bayesian information criterion ``chi^2 + k ln n + 2 ln C(c, k)`` is chosen. Here n is the number of
data, k the number of chosen places and c the number of candidates. If the noise is not known,
``n ln(e/n)`` with the squared error e replaces ``chi^2``. The last term counts in how many ways k
of c places can be chosen. It prevents that a place is named by chance if no place has changed.
Give more data than `most` unknowns to find the places that differ.

An error that is present everywhere (Young's modulus, damping) can hide an error at one place. Pass
such parameters as `nuisance`. They are fitted anew with every candidate, and also without any
candidate. The score of a candidate is then only what the nuisance parameters cannot explain. Before
the exact fits this score is ``(J_c^T r)^2 / (J_c^T J_c)``, where r is the residual and J_c its
derivative, both without the part that the nuisance parameters explain.

**update.** For eigenvalues alone, without bounds and priors, the method is that of equations (13)
and (14) of the paper, a Gauss-Newton method with real unknowns in complex equations::

    Re[S^H W S] dp = Re[S^H W d lambda],    p <- p + dp

Otherwise ``1/2 |r(p)|^2 + 1/2 |(p - mean)/std|^2`` is minimised in a trust region within the
bounds. Here r are the whitened residuals of all kinds. The second term belongs to the parameters
with a prior. It is used only if the noise of every residual is known; the result is then the
maximum a posteriori estimate.

Modes are found by their number in the model at `start`. After that they are followed by their
shapes (see `flexplant.updating.family`), so that they may change their order. Modes with measured
shapes are assigned by the MAC in each step. If modes at `start` are exactly repeated, they are
first replaced by the combinations into which the step splits them, and the lower mode number gets
the lower frequency. A step is shortened if M or K would become indefinite, a measured mode would
cease to oscillate, or the error (12) would grow.

**design_hinf.** First the plant is scaled and balanced. A sampled plant is mapped to continuous
time by a map that keeps its norms. Then the chosen method computes the controller, which is
transformed back to the user's channels and units. Finally the closed loop of this controller is
checked: it must be stable, and its norm is computed by two methods.

**tune_loops.** Each axis gets the law
``k (1 + w_i / s) (1 + a s / w_b) / (1 + s / (b w_b)) F(s)``, where F contains a low-pass and
notches. w_b is the crossover of the loop of the rigid body alone. It is made as large as the limit
``|1 + L| >= 1 / peak`` allows, and may lie above resonances. The values of a and b, the corner of
the low-pass, and the frequency, depth and width of the notches are optimised from many starting
points. The best result is used, but it is not proven that no other law is better. w_i is w_b / 10.
No zero lies below w_i, and no corner lies above 0.45 of the rate or above the last line.

The laws are first found for each axis separately. If together they do not keep the limit on the
peak, the laws of all axes are changed together until they do, with the largest geometric mean of
their bandwidths. The limit then holds for |S| of each axis while the loops of the others are
closed. It also holds for the largest singular value of S at u and at y, if the channels of this
side have one unit. If truncated modes are known, it holds with these modes too. If the limit cannot
be kept, the laws that come closest to it are returned, with a warning that says what ended the
search.

No model is needed, because the plant may be an Frf. The true value of a measured line is assumed to
lie anywhere within two standard deviations. The deviation follows from the variance; without a
variance from the coherence (with the number of averages from `freedom`, or two averages if it is
not given); otherwise from the scatter of the lines. If a resonance turns between two lines, the
response is assumed to follow the circle through the neighbouring lines. If the lines do not resolve
a resonance, the loop gain has to be small there. Peaks between two lines that do not appear in any
line remain unknown, so the lines have to be closer than a mode is wide. Above the last line the
plant is unknown, and the loop gain may be at most 0.1 there.

**stage_weights.** Let Y = G_yu T be the motions of the sensors for unit motions of the decoupled
axes, at the real frequency sigma = 2 pi f_c. The frequency f_c is 1.6 times the bandwidth. Axis i
is multiplied by d_i = rms(Y_i) / rms(Y_1). Actuator j has the size f0_j = (m / r)^(1/2) |(T / d)_j|
for m actuators and r axes. The noise of a sensor is proportional to its signal for unit motions of
all axes. In these units the blocks are

.. math:: \begin{bmatrix} W_S S & W_S P W_d \\ W_u K S & W_u K P W_d \end{bmatrix}

1/W_S rises as f/f_c up to `peak`, W_u lets the efforts roll off from 6 f_c, and W_d is
`disturbance` times f0 at the actuators. Elsewhere W_d is a hundredth of it, if the actuators have
noise. If the disturbances of w and the noise of the actuators leave an axis at rest, every actuator
gets a disturbance. Sensors of velocity (acceleration) do not show where the machine rests. For them
W_S has a high-pass of first (second) order at f_c. If a sensor represents the axis of a free motion
that no POI shows, z contains the signal of this sensor without noise (`y1:signal`), so that this
motion is held at zero. K P W_d is the complementary sensitivity T at u. The weights of z are
divided by ``peak disturbance effort``, so that gamma = 1 requires |T| < peak at u. With the default
ratios this block decides, and gamma is the ratio of |T| to its limit. The controller lists the
value that each block reaches (`Controller.reached`).

**design_kalman.** The noise model is that of `simulate`: `plant.process_noise` is added to x in
each sample, and `plant.sensor_noise` to the sample of y. Delays of u are assumed to be known
exactly. The Riccati equation is solved in scaled units (`flexplant.lti.filter_dare`). If there is
so little noise that P has too few digits, it is solved for square roots of P ([Hewer1971]_, by QR
factors). Truncated modes add no states. Their motion under the disturbances is noise with the
covariances R_t at the sensors, V_t at the POIs and N_t between them. Their response to u is their
static compliance. The gains are::

    S = C2 P C2' + R + R_t,   L = P C2' S^-1,   L_z = (C1 P C2' + N_t) S^-1

where P solves the Riccati equation of (A, C2, Q, R + R_t). If u has no delay, the static compliance
is left out, because it would close an algebraic loop from y to u to y.
"""
