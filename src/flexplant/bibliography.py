"""The sources of what is computed, by the keys that docstrings cite: ``[Guyan1965]_``.

.. [paper] "Finite Element Model Reduction and Model Updating of structures for Control": the method
   that this library is built on.
.. [Abedor1996] Abedor, Nagpal, Poolla, A linear matrix inequality approach to peak-to-peak gain
   minimization, Int. J. Robust Nonlinear Control 6, 1996.
.. [AlexandrovLewis2001] Alexandrov, Lewis, An overview of first-order model management for
   engineering optimization, Optim. Eng. 2, 2001.
.. [Allemang2003] Allemang, The modal assurance criterion: twenty years of use and abuse, Sound and
   Vibration 37, 2003, 14-21.
.. [AllemangBrown1982] Allemang, Brown, A correlation coefficient for modal vector analysis, IMAC 1,
   1982.
.. [AndersonLiu1989] Anderson, Liu, Controller reduction: concepts and approaches, IEEE Trans.
   Autom. Control 34, 1989.
.. [AndersonMoore1979] Anderson, Moore, Optimal Filtering, Prentice Hall, 1979.
.. [Aphale2007] Aphale, Fleming, Moheimani, Integral resonant control of collocated smart
   structures, Smart Mater. Struct. 16, 2007.
.. [ApkarianNoll2006] Apkarian, Noll, Nonsmooth H-infinity synthesis, IEEE Trans. Autom. Control 51,
   2006.
.. [AstromMurray2008] Astrom, Murray, Feedback Systems, Princeton University Press, 2008.
.. [AstromWittenmark1997] Astrom, Wittenmark, Computer-Controlled Systems, 3rd ed., Prentice Hall,
   1997.
.. [BaiSu2005] Bai, Su, Dimension reduction of large-scale second-order dynamical systems via a
   second-order Arnoldi method, SIAM J. Sci. Comput. 26, 2005.
.. [BarShalom2001] Bar-Shalom, Li, Kirubarajan, Estimation with Applications to Tracking and
   Navigation, Wiley, 2001.
.. [Bartlett1955] Bartlett, An Introduction to Stochastic Processes, Cambridge, 1955.
.. [BarzilaiBorwein1988] Barzilai, Borwein, Two-point step size gradient methods, IMA J. Numer.
   Anal. 8, 1988.
.. [BendatPiersol2010] Bendat, Piersol, Random Data, 4th ed., Wiley, 2010.
.. [BittantiColaneri2009] Bittanti, Colaneri, Periodic Systems, Springer, 2009.
.. [Boerlage2004] Boerlage, Tousain, Steinbuch, Jerk derivative feedforward control for motion
   systems, American Control Conference, 2004.
.. [Boisvert1996] Boisvert, Pozo, Remington, The Matrix Market exchange formats: initial design,
   NISTIR 5935, 1996.
.. [BoydBalakrishnan1990] Boyd, Balakrishnan, A regularity result for the singular values of a
   transfer matrix and a quadratically convergent algorithm for computing its L-infinity norm, Syst.
   Control Lett. 15, 1990.
.. [BoydElGhaoui1993] Boyd, El Ghaoui, Method of centers for minimizing generalized eigenvalues,
   Linear Algebra Appl. 188, 1993.
.. [Branch1999] Branch, Coleman, Li, A subspace, interior, and conjugate gradient method for
   large-scale bound-constrained minimization problems, SIAM J. Sci. Comput. 21, 1999.
.. [BruinsmaSteinbuch1990] Bruinsma, Steinbuch, A fast algorithm to compute the H-infinity norm of a
   transfer function matrix, Syst. Control Lett. 14, 1990.
.. [BrysonFrazier1963] Bryson, Frazier, Smoothing for linear and nonlinear dynamic systems, Optimum
   System Synthesis Conference, 1963.
.. [Cauberghe2004] Cauberghe, Applied frequency-domain system identification in the field of
   experimental and operational modal analysis, PhD thesis, Vrije Universiteit Brussel, 2004.
.. [Chen2008] Chen, Davis, Hager, Rajamanickam, Algorithm 887: CHOLMOD, supernodal sparse Cholesky
   factorization and update/downdate, ACM Trans. Math. Softw. 35, 2008.
.. [ChenChen2008] Chen, Chen, Extended Bayesian information criteria for model selection with large
   model spaces, Biometrika 95, 2008.
.. [Chu2004] Chu, Fan, Lin, Wang, Structure-preserving algorithms for periodic discrete-time
   algebraic Riccati equations, Int. J. Control 77, 2004.
.. [Chu2005] Chu, Fan, Lin, A structure-preserving doubling algorithm for continuous-time algebraic
   Riccati equations, Linear Algebra Appl. 396, 2005.
.. [CraigBampton1968] Craig, Bampton, Coupling of substructures for dynamic analyses, AIAA J. 6,
   1968.
.. [CraigKurdila2006] Craig, Kurdila, Fundamentals of Structural Dynamics, 2nd ed., Wiley, 2006.
.. [deJong1989] de Jong, Smoothing and interpolation with the state-space model, J. Amer. Stat.
   Assoc. 84, 1989.
.. [deJong1991] de Jong, The diffuse Kalman filter, Ann. Statist. 19, 1991.
.. [deKlerk2008] de Klerk, Rixen, Voormeeren, General framework for dynamic substructuring: history,
   review and classification of techniques, AIAA J. 46, 2008.
.. [Demmel1989] Demmel, On floating point errors in Cholesky, LAPACK Working Note 14, 1989.
.. [Dobrowiecki2006] Dobrowiecki, Schoukens, Guillaume, Optimized excitation signals for MIMO
   frequency response function measurements, IEEE Trans. Instrum. Meas. 55, 2006, 1778-1786.
.. [Doyle1986] Doyle, Lenz, Packard, Design examples using mu-synthesis, IEEE CDC, 1986.
.. [Duff1992] Duff, Grimes, Lewis, Users' guide for the Harwell-Boeing sparse matrix collection,
   CERFACS, 1992.
.. [DuffReid1983] Duff, Reid, The multifrontal solution of indefinite sparse symmetric linear
   equations, ACM Trans. Math. Softw. 9, 1983.
.. [EmamiNaeiniVanDooren1982] Emami-Naeini, Van Dooren, Computation of zeros of linear multivariable
   systems, Automatica 18, 1982.
.. [Enns1984] Enns, Model reduction with balanced realizations, IEEE CDC, 1984.
.. [Fan1991] Fan, Tits, Doyle, Robustness in the presence of mixed parametric uncertainty and
   unmodeled dynamics, IEEE Trans. Autom. Control 36, 1991.
.. [Fanson1990] Fanson, Caughey, Positive position feedback control for large space structures, AIAA
   J. 28, 1990.
.. [FanTits1992] Fan, Tits, A measure of worst-case H-infinity performance and of largest acceptable
   uncertainty, Syst. Control Lett. 18, 1992.
.. [Fiedler1973] Fiedler, Algebraic connectivity of graphs, Czechoslovak Math. J. 23, 1973.
.. [Fletcher1987] Fletcher, Practical Methods of Optimization, 2nd ed., Wiley, 1987.
.. [Franklin1998] Franklin, Powell, Workman, Digital Control of Dynamic Systems, 3rd ed.,
   Addison-Wesley, 1998.
.. [FriedmanKosmatka1993] Friedman, Kosmatka, An improved two-node Timoshenko beam finite element,
   Computers & Structures 47, 1993, 473-481.
.. [FriswellGarveyPenny1995] Friswell, Garvey, Penny, Model reduction using dynamic and iterated IRS
   techniques, J. Sound and Vibration 186, 1995.
.. [FriswellGarveyPenny1998] Friswell, Garvey, Penny, The convergence of the iterated IRS method, J.
   Sound and Vibration 211, 1998.
.. [GahinetApkarian1994] Gahinet, Apkarian, A linear matrix inequality approach to H-infinity
   control, Int. J. Robust Nonlinear Control 4, 1994.
.. [Gawronski2004] Gawronski, Advanced Structural Dynamics and Active Control of Structures,
   Springer, 2004.
.. [George1973] George, Nested dissection of a regular finite element mesh, SIAM J. Numer. Anal. 10,
   1973.
.. [Giraud2005] Giraud, Langou, Rozloznik, van den Eshof, Rounding error analysis of the classical
   Gram-Schmidt orthogonalization process, Numer. Math. 101, 2005.
.. [Glover1984] Glover, All optimal Hankel-norm approximations of linear multivariable systems and
   their L-infinity error bounds, Int. J. Control 39, 1984.
.. [GloverDoyle1988] Glover, Doyle, State-space formulae for all stabilizing controllers that
   satisfy an H-infinity-norm bound, Syst. Control Lett. 11, 1988.
.. [GolubPereyra2003] Golub, Pereyra, Separable nonlinear least squares: the variable projection
   method and its applications, Inverse Problems 19, 2003, R1-R26.
.. [Gregory1984] Gregory, Reduction of large flexible spacecraft models using internal balancing
   theory, J. Guid. Control Dyn. 7, 1984.
.. [Grimes1994] Grimes, Lewis, Simon, A shifted block Lanczos algorithm for solving sparse symmetric
   generalized eigenproblems, SIAM J. Matrix Anal. Appl. 15, 1994.
.. [Guyan1965] Guyan, Reduction of stiffness and mass matrices, AIAA J. 3, 1965.
.. [Hammarling1982] Hammarling, Numerical solution of the stable, non-negative definite Lyapunov
   equation, IMA J. Numer. Anal. 2, 1982.
.. [Hanus1987] Hanus, Kinnaert, Henrotte, Conditioning technique, a general anti-windup and bumpless
   transfer method, Automatica 23, 1987.
.. [Hewer1971] Hewer, An iterative technique for the computation of the steady state gains for the
   discrete optimal regulator, IEEE Trans. Autom. Control 16, 1971, 382-384.
.. [HeylenLammens1996] Heylen, Lammens, FRAC: a consistent way of comparing frequency response
   functions, Identification in Engineering Systems, 1996.
.. [Higham2008] Higham, Functions of Matrices: Theory and Computation, SIAM, 2008.
.. [Hosking1980] Hosking, The multivariate portmanteau statistic, J. Amer. Stat. Assoc. 75, 1980.
.. [Imamovic1998] Imamovic, Validation of large structural dynamics models using modal test data,
   PhD thesis, Imperial College, 1998.
.. [JoshiBoyd2009] Joshi, Boyd, Sensor selection via convex optimization, IEEE Trans. Signal
   Process. 57, 2009.
.. [Kammer1991] Kammer, Sensor placement for on-orbit modal identification and correlation of large
   space structures, J. Guid. Control Dyn. 14, 1991.
.. [KassRaftery1995] Kass, Raftery, Bayes factors, J. American Statistical Association 90, 1995.
.. [Katili1993] Katili, A new discrete Kirchhoff-Mindlin element based on Mindlin-Reissner plate
   theory and assumed shear strain fields, Int. J. Numer. Methods Eng. 36, 1993, 1885-1908.
.. [Kaufman1975] Kaufman, A variable projection method for solving separable nonlinear least squares
   problems, BIT 15, 1975.
.. [Kautsky1985] Kautsky, Nichols, Van Dooren, Robust pole assignment in linear state feedback,
   Int. J. Control 41, 1985.
.. [KennedyOHagan2001] Kennedy, O'Hagan, Bayesian calibration of computer models, J. Royal
   Statistical Society B 63, 2001.
.. [KuczynskiWozniakowski1992] Kuczynski, Wozniakowski, Estimating the largest eigenvalue by the
   power and Lanczos algorithms with a random start, SIAM J. Matrix Anal. Appl. 13, 1992.
.. [Kwakernaak1993] Kwakernaak, Robust control and H-infinity optimization, Automatica 29, 1993.
.. [Lainiotis1975] Lainiotis, Partitioned linear estimation algorithms: discrete case, IEEE Trans.
   Autom. Control 20, 1975.
.. [Lambrechts2005] Lambrechts, Boerlage, Steinbuch, Trajectory planning and feedforward design for
   electromechanical motion systems, Control Eng. Pract. 13, 2005.
.. [Laub1979] Laub, A Schur method for solving algebraic Riccati equations, IEEE Trans. Autom.
   Control 24, 1979.
.. [Laub1987] Laub, Heath, Paige, Ward, Computation of system balancing transformations, IEEE Trans.
   Autom. Control 32, 1987.
.. [Lawrence2000] Lawrence, Tits, Van Dooren, A fast algorithm for the computation of an upper bound
   on the mu-norm, Automatica 36, 2000.
.. [LawsonHanson1995] Lawson, Hanson, Solving Least Squares Problems, SIAM, 1995.
.. [LewisOverton2013] Lewis, Overton, Nonsmooth optimization via quasi-Newton methods, Math.
   Program. 141, 2013.
.. [LiuAnderson1989] Liu, Anderson, Singular perturbation approximation of balanced systems, Int. J.
   Control 50, 1989.
.. [LjungBox1978] Ljung, Box, On a measure of lack of fit in time series models, Biometrika 65,
   1978.
.. [MacNeal1971] MacNeal, A hybrid method of component mode synthesis, Computers & Structures 1,
   1971.
.. [Manohar2018] Manohar, Brunton, Kutz, Brunton, Data-driven sparse sensor placement for
   reconstruction, IEEE Control Systems 38, 2018.
.. [McFarlaneGlover1992] McFarlane, Glover, A loop-shaping design procedure using H-infinity
   synthesis, IEEE Trans. Autom. Control 37, 1992.
.. [Michiels2014] Michiels, Niculescu, Stability, Control, and Computation for Time-Delay Systems,
   2nd ed., SIAM, 2014.
.. [Mindlin1951] Mindlin, Influence of rotatory inertia and shear on flexural motions of isotropic,
   elastic plates, J. Appl. Mech. 18, 1951, 31-38.
.. [Modelica2022] Modelica Association, Functional Mock-up Interface for Model Exchange,
   Co-Simulation, and Scheduled Execution, version 3.0, 2022.
.. [MorganScott1986] Morgan, Scott, Generalizations of Davidson's method for computing eigenvalues
   of sparse symmetric matrices, SIAM J. Sci. Stat. Comput. 7, 1986.
.. [OCallahan1989a] O'Callahan, A procedure for an improved reduced system (IRS) model, IMAC 7,
   1989.
.. [OCallahan1989b] O'Callahan, Avitabile, Riemer, System equivalent reduction expansion process
   (SEREP), IMAC 7, 1989.
.. [Odelson2006] Odelson, Rajamani, Rawlings, A new autocovariance least-squares method for
   estimating noise covariances, Automatica 42, 2006.
.. [OkabeIto2008] Okabe, Ito, Color universal design, jfly.uni-koeln.de/color, 2008.
.. [Osborne1960] Osborne, On pre-conditioning of matrices, J. ACM 7, 1960.
.. [PackardDoyle1993] Packard, Doyle, The complex structured singular value, Automatica 29, 1993.
.. [Pascual1997] Pascual, Golinval, Razeto, A frequency domain correlation technique for model
   correlation and updating, IMAC 15, 1997.
.. [PattersonThompson1971] Patterson, Thompson, Recovery of inter-block information when block sizes
   are unequal, Biometrika 58, 1971.
.. [PauleMandel1982] Paule, Mandel, Consensus values and weighting factors, J. Res. Natl. Bur.
   Stand. 87, 1982, 377-385.
.. [Peeters2004] Peeters, Van der Auweraer, Guillaume, Leuridan, The PolyMAX frequency-domain
   method: a new standard for modal parameter estimation?, Shock and Vibration 11, 2004, 395-409.
.. [PeetersDeRoeck1999] Peeters, De Roeck, Reference-based stochastic subspace identification for
   output-only modal analysis, Mech. Syst. Signal Process. 13, 1999.
.. [PerezArriaga1982] Perez-Arriaga, Verghese, Schweppe, Selective modal analysis with applications
   to electric power systems, IEEE Trans. Power App. Syst. 101, 1982.
.. [Piessens1983] Piessens, de Doncker-Kapenga, Ueberhuber, Kahaner, QUADPACK: A Subroutine Package
   for Automatic Integration, Springer, 1983.
.. [Pintelon2007] Pintelon, Guillaume, Schoukens, Uncertainty calculation in (operational) modal
   analysis, Mech. Syst. Signal Process. 21, 2007, 2359-2373.
.. [PintelonSchoukens2012] Pintelon, Schoukens, System Identification: A Frequency Domain Approach,
   2nd ed., Wiley, 2012.
.. [Preumont2018] Preumont, Vibration Control of Active Structures, 4th ed., Springer, 2018.
.. [Reynders2008] Reynders, Pintelon, De Roeck, Uncertainty bounds on modal parameters obtained from
   stochastic subspace identification, Mech. Syst. Signal Process. 22, 2008.
.. [Richardson1911] Richardson, The approximate arithmetical solution by finite differences of
   physical problems, Phil. Trans. Royal Society A 210, 1911, 307-357.
.. [Rubin1975] Rubin, Improved component-mode representation for structural dynamic analysis, AIAA
   J. 13, 1975.
.. [SalimbahramiLohmann2006] Salimbahrami, Lohmann, Order reduction of large scale second-order
   systems using Krylov subspace methods, Linear Algebra Appl. 415, 2006.
.. [Scherer1997] Scherer, Gahinet, Chilali, Multiobjective output-feedback control via LMI
   optimization, IEEE Trans. Autom. Control 42, 1997.
.. [Seiler2020] Seiler, Packard, Gahinet, An introduction to disk margins, IEEE Control Syst. Mag.
   40(5), 2020, 78-95.
.. [Singer1990] Singer, Seering, Preshaping command inputs to reduce system vibration, J. Dyn. Syst.
   Meas. Control 112, 1990.
.. [Singhose1994] Singhose, Seering, Singer, Residual vibration reduction using vector diagrams to
   generate shaped inputs, J. Mech. Des. 116, 1994.
.. [Skogestad2005] Skogestad, Postlethwaite, Multivariable Feedback Control, 2nd ed., Wiley, 2005.
.. [Sleijpen1996] Sleijpen, Booten, Fokkema, van der Vorst, Jacobi-Davidson type methods for
   generalized eigenproblems and polynomial eigenproblems, BIT 36, 1996.
.. [Smith1968] Smith, Matrix equation XA + BX = C, SIAM J. Appl. Math. 16, 1968.
.. [Smith1970] Smith, Error bounds for zeros of a polynomial based upon Gerschgorin's theorem, J.
   ACM 17, 1970.
.. [Stetter1978] Stetter, The defect correction principle and discretization methods, Numer. Math.
   29, 1978.
.. [Stoorvogel1992] Stoorvogel, The H-infinity Control Problem: A State Space Approach, Prentice
   Hall, 1992.
.. [TombsPostlethwaite1987] Tombs, Postlethwaite, Truncated balanced realization of a stable
   non-minimal state-space system, Int. J. Control 46, 1987.
.. [vanderSeijs2013] van der Seijs, van den Bosch, Rixen, de Klerk, An improved methodology for the
   virtual point transformation of measured frequency response functions in dynamic substructuring,
   COMPDYN, 2013.
.. [VandeWijdevenBosgra2010] Van de Wijdeven, Bosgra, Using basis functions in iterative learning
   control: analysis and design theory, Int. J. Control 83, 2010.
.. [VanLoan1978] Van Loan, Computing integrals involving the matrix exponential, IEEE Trans. Autom.
   Control 23, 1978.
.. [VanZundertOomen2018] Van Zundert, Oomen, On inversion-based approaches for feedforward and ILC,
   Mechatronics 50, 2018.
.. [VoormeerenRixen2012] Voormeeren, Rixen, A family of substructure decoupling techniques based on
   a dual assembly approach, Mech. Syst. Signal Process. 27, 2012.
.. [Welch1967] Welch, The use of fast Fourier transform for the estimation of power spectra, IEEE
   Trans. Audio Electroacoust. 15, 1967.
.. [Whittle1953] Whittle, The analysis of multiple stationary time series, and Estimation and
   information in stationary time series, Arkiv foer Matematik 2, 1953.
.. [WolkowiczStyan1980] Wolkowicz, Styan, Bounds for eigenvalues using traces, Linear Algebra Appl.
   29, 1980.
.. [Young1990] Young, Doyle, Computation of mu with real and complex uncertainties, IEEE CDC, 1990.
.. [ZhouDoyleGlover1996] Zhou, Doyle, Glover, Robust and Optimal Control, Prentice Hall, 1996.
"""
