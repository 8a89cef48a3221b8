"""flexplant: standard plants for flexible machines.

The way from finite-element matrices and a measurement to the closed-loop error at a point of
interest (POI)::

    FEModel --solve_modes--> Modes --reduce--> ReducedModel --update--> UpdateResult.model
      (M, D, K, dofs)                           (M*, D*, K*, T)  ^            |
                                              MeasuredModes -----'            |
                                     assemble_plant(model, ports, evaluation=whole)
                                                                              v
      +-----------+   [w;u] -> [z;y]      StandardPlant --discretized(rate, delay)--> sampled
    z<|           |<w                          +-----------+-----------+--------------+
    y<|     P     |<u                  design_kalman   design_servo,   score_sensors,
      +-----------+                            |       design_hinf     place_sensors, ...
        +-->K--+                               v           v
                         close_loop(plant, *blocks) --> ClosedLoop --simulate--> Response

The same `Ports` serve every model of one machine: the drawing, the updated model, and the virtual
machine. flexplant is divided into rooms, which are modules such as `fx.plant`. Each room below has
a page, for example ``help(fx.plant)``, with its purpose, an example, and the names of the same
functions in other tools.

>>> import flexplant as fx
>>> plant = fx.testbeds.three_masses()
>>> observer = fx.design_kalman(plant)
>>> servo = fx.design_servo(plant, bandwidth=20.0, observer=observer)
>>> print(fx.close_loop(plant, observer, servo))
<ClosedLoop: plant 7 states, controller 11 states, dt 0.0005 s>
  stable: spectral radius 0.996842717, modulus margin 0.57
  driven: u1
  monitored: die:hat
  not judged on a larger model
  not judged on a measurement
  stays stable if one modal frequency (not its shape) shifts by 1 %

**Conventions**

| convention | |
|---|---|
| units | SI; `freq` in Hz, `omega` in rad/s; rx = dz/dy, ry = -dz/dx |
| spectra | `psd`, `asd` one-sided; white noise has the intensity asd^2 / 2 |
| channels | inputs `[w; u]`, outputs `[z; y]`; `u = K y`: the sign is in the controller |
| names | `die:z` (POI), `die:ref`, `die:error` (reference minus POI), `die:hat` (estimate) |
| time | dt = 0 is continuous; within a sample: measure, update, control, hold |
| modes | numbered from 1, including rigid-body modes; only dampers damp rigid-body modes |

**What to rely on**

- Every result is checked by a second method. The predicted error of a Kalman filter is computed
  again from a Stein equation. An H-infinity controller is verified by its closed-loop norm, once
  with proof and once by a frequency sweep. Modes are verified by residuals and a count. A failed
  check raises an error.
- Checks go beyond the design model. A plant knows its *evaluation model*, a larger model of the
  same machine. The modes that the plant lacks count as noise in the predicted error of a filter,
  and every loop is also tested on the plant with these modes. A loop that becomes unstable by them
  is reported. If a plant has no evaluation model, its results say so. For a fit, chi-square shows
  whether the parameters explain the data.
- SI units need no scaling by the user. Gains of 1e-9 m/N, damping of 0.1 %, rigid-body modes at
  exactly 0 Hz and repeated modes are scaled internally.
- Nothing is repaired silently. Error messages state what is wrong, which value was found, why
  it matters and what to do next.

**Which example for which task** (``python examples/<name>.py`` in the repository)

- see what a model and a measurement gain: `examples/wafer_stage.py`
- read matrices of a finite-element program: `examples/from_nastran.py`; an imported solid in six
  axes: `examples/solid_stage.py`
- mesh a body with holes by scikit-fem: `examples/from_skfem.py`
- reduce: `examples/reduction_methods.py`, twelve ways in one table
- solve a large model: `examples/million_dofs.py`
- identify and update: `examples/measured_frf.py`; a real record: `examples/ruler.py`; the paper's
  numbers and figures: `examples/paper_plate.py`
- estimate from records: `examples/recorded_data.py`; a POI that moves: `examples/moving_poi.py`
- control six axes: `examples/maglev.py`; a stage that scans below sensors on its frame:
  `examples/scanning_stage.py`
- shape loops by hand in a browser, on measured responses: `examples/workbench.py`
- from the files of a project to C code: `examples/gantry.py`; follow set-points:
  `examples/feedforward.py`
- design by mixed sensitivity, on textbook plants: `examples/textbook.py`; margins, LQG, PID, mu and
  delays as textbooks have them: `examples/classical.py`
- damp modes actively, then move, with input shapers: `examples/active_damping.py`
- guarantee robustness: `examples/robust_control.py`
- join components: `examples/joined_machine.py`
- place sensors and actuators: `examples/placement.py`
- design for many machines: `examples/fleet.py`
- write a specification as tests: `examples/test_specifications.py`
- run a controller in C with the machine, at 10 kHz: `examples/real_time.py`

**Compared with other packages.** CPU seconds on one core of a server, for flexplant and another
package (peer), each row in one run of
``OMP_NUM_THREADS=1 python tests/benchmarks/readme_table.py``. A ratio above 1 means that flexplant
is faster. Before the times are taken, the results are compared. Times vary by about 20 % from run
to run. The rows of 30 603 DOFs are from a run in which other work used both cores.

| task | flexplant | peer | its time | ratio |
|---|---|---|---|---|
| 24 modes of a solid, 27 783 DOFs | 2.5 s | scipy eigsh | 20 s | 8 |
| 24 modes of a plate, 30 603 DOFs | 0.95 s | scipy eigsh on CHOLMOD | 0.98 s | 1 |
| 24 modes of a plate, 30 603 DOFs | 1 s | scipy eigsh on PARDISO | 0.76 s | 0.76 |
| all 243 modes of a plate, dense | 7 ms | scipy eigh | 4.3 ms | 0.62 |
| 200 lines of a plate's responses, 30 000 DOFs | 1.1 s | scipy splu (4 of them) | 340 s | 310 |
| 8 x 8 frequency responses, 10 000 lines | 3.5 ms | python-control, slycot | 0.11 s | 31 |
| H-infinity norm, 48 states, 0.1 % damping | 1.6 ms | slycot ab13dd | 1.9 ms | 1.2 |
| the same, A dense | 1.7 ms | slycot ab13dd | 1.9 ms | 1.1 |
| H2 norm, 200 states | 1.7 ms | python-control, slycot | 3.3 ms | 1.9 |
| zero-order hold, 48 states | 0.098 ms | scipy cont2discrete | 0.12 ms | 1.3 |
| a discrete Riccati equation, 48 states | 2.5 ms | scipy solve_discrete_are | 6.2 ms | 2.5 |
| 100 000 samples through a Kalman filter | 28 ms | filterpy (5000 of them) | 4.5 s | 160 |
| 100 000 samples of a loop, 212 states | 43 ms | python-control | 1.2 s | 27 |
| the same with its white noises | 0.12 s | python-control | 1.1 s | 8.8 |
| the loop with saturated commands | 1.4 s | python-control (2000 of them) | 2.5 s | 1.8 |
| H-infinity, 3 states: norm 0.137 | 9.1 ms | python-control, slycot: 0.137 | 15 ms | 1.6 |
| H-infinity, 61 states of a stage: norm 0.901 | 0.23 s | slycot: no answer in 10 s | - | - |
| mu of 12 complex scalars, both bounds | 10 ms | slycot ab13md, the upper one | 11 ms | 1 |
| the upper bound alone | 6 ms | slycot ab13md, the upper one | 10 ms | 1.7 |
| poles of a close pair in noise: error 5e-07 | 0.1 s | scikit-rf: 7e-07 | 79 ms | 0.79 |
| a sparse OUTPUT4 file of Nastran | 6.4 ms | pyYeti | 24 ms | 3.7 |

Peers are faster for some tasks because flexplant also checks its results. For all modes of the
plate, a quarter of the time goes into residuals. Another quarter goes into the separation of
rigid-body motions and the full accuracy of soft modes.
With a factor of CHOLMOD or of MKL PARDISO, eigsh is twice as fast as `solve_modes` on a plate of
10 000 DOFs. With PARDISO it is 1.3 times faster on a plate of 30 000 DOFs, 1.2 times faster on a
plate of 99 000 DOFs, and as fast on a solid of 28 000 DOFs. With CHOLMOD it is as fast on the plate
of 30 000 DOFs, 1.2 times slower on that of 99 000, and 2.3 times slower on the solid
(``tests/benchmarks/modes_peers.py``, whose peers are the wheels `sksparse-minimal` and
`pypardiso`). With a factor of PARDISO, `solve_modes` was at most 1.2 times faster than with its
own, because the count, the orthogonalisation and the checks take most of the time.
``python -m pytest -n 0 -m benchmark -s tests/benchmarks`` measures many more times.

**Limits**

- Tested sizes of models: 2 to 998 787 DOFs. 24 modes of the largest plate take 39 to 45 s and 4.8
  GB on one core, and those of a solid of 292 008 DOFs 85 s and 4.1 GB
  (``python tests/benchmarks/modes_peers.py solid 45 ours`` repeats this; `flexplant.sparse`
  explains memory settings).
- Tested sizes of plants: 2 to 490 states. A Kalman filter of 1000 states takes 18 s and 0.4 GB; the
  time grows with the third power of the number of states. H-infinity in six axes with 40 modes
  takes 3 s.
- Other tested sizes: a choice of four among 1024 candidate places (41 s; its score is 0.7 % above
  the proven bound), studies of 10 000 machines (91 MB of memory throughout), and 1e8 samples of a
  filter in C.
- Tested dampings: 0.01 % to 1 %, no damping, and magnets of negative stiffness.
- Tested units: SI, and files in mm and t or other units of length, mass and time.
- Structures are linear and time-invariant, with symmetric M, D and K. Gyroscopic terms, contact and
  temperature are not modelled. POIs may move.

**From 0.1 to 0.2**

| 0.1 | 0.2 |
|---|---|
| ``larger=whole`` of any function | ``assemble_plant(model, ports, evaluation=whole)`` |
| ``larger=plant`` (no truncated modes) | ``plant.replace(evaluation=None)`` |
| ``larger_plant(plant, whole)`` | ``plant.evaluation_plant`` |
| ``PoiVariance(larger=)``, ``LeftOutModes(larger)`` | the plant's evaluation model |
| ``simulation.MachinePipeline`` | a function for `study`, as in `examples/fleet.py` |
| ``study(timeout=)`` | gone; ``study(key=)`` names the study of a checkpoint |
| ``weighted``, ``through`` give a StandardPlant | a `plant.GeneralizedPlant` |
| ``plant.is_weighted`` | ``isinstance(plant, GeneralizedPlant)`` |
| ``plant.is_assembled`` | ``plant.model is not None``; ``plant.ports`` of any plant |
| ``plant.unweighted`` of any plant | of a GeneralizedPlant; ``plant.machine`` of any |
| ``plant.uncertain(fit, modes=, deviations=)`` | ``plant.uncertain(Fit(fit, modes=))`` |
| ``plant.uncertain(gain=, delay=)`` | ``plant.uncertain(Gains(...), Delay(...))`` |
| ``plant.uncertain(shapes=, neglected=)`` | ``plant.uncertain(Shapes(...), Neglected())`` |
| ``decouple``: mass, centre of gravity | `plant.gravity_axes`; `decouple` gives driven axes |
| ``lti.solve_care``, ``lti.solve_dare`` | `lti.filter_care`, `lti.filter_dare` |
| ``lowpass``, ``lti.highpass`` | `lti.low_pass_filter`, `lti.high_pass_filter` |
| ``lti.notch``, ``lti.leadlag`` | `lti.notch_filter`, `lti.lead_lag_filter` |
| ``discretized``, ``localise``, ``Guyan``, ... | in their rooms: ``fx.reduction.Guyan`` |
| ``estimation.Consistency`` | `estimation.ConsistencyReport` |
| ``updating.Identifiability`` | `updating.IdentifiabilityReport` |
| ``lti.Split``, ``workbench.Workbench`` | `lti.StableSplit`, `workbench.WorkbenchServer` |
| ``simulation.SetPoint`` | `simulation.SetPointProfile` |
| ``simulation.FiltersAlong``, ``RmsAlong`` | `simulation.PathFilters`, `simulation.PathRms` |
| ``placement.Among``, ``Together`` | `placement.CountLimits`, `placement.JointGroups` |
| ``placement.Within``, ``AfterLoss`` | `placement.ZoneLimits`, `placement.DeviceLoss` |
| ``placement.ByRows``, ``Found`` | `placement.RowSelection`, `placement.SearchResult` |
| ``plant.Along`` | `plant.PortPath` |
| ``plant.Seen``, ``plant.Moves`` | `plant.MeasuredRow`, `plant.PlaceMotion` |
| ``synthesis.fixed_point`` | gone: `export.write_c` computes in float or double |
| ``design_hinf_filter``, ``design_minimax_filter`` | `design_kalman`; `plant.uncertain` |
| ``simulation.certify_speed`` | gone: `simulation.rms_along(..., repeats=True)`, one path |
| ``kirchhoff_plate(holes=, ribs=)`` | gone: a mesh of scikit-fem, `examples/from_skfem.py` |
| ``structure.Disc``, ``structure.Rectangle`` | `placement.Disc`, `placement.Rectangle` |
| ``io.write_fmu``, ``synthesis.write_c`` | `export.write_fmu`, `export.write_c` |
| ``fx.workbench(...)`` | `workbench.open_page` |
| ``KalmanCertificate`` and others of its kind | `loop.Certificate`, a sequence of `loop.Verified` |
| ``placement.HinfLevel`` | ``lambda plant: fx.design_hinf(plant.weighted(...)).gamma`` |
| ``structure.Hysteretic`` | `ModalDamping` of eta / 2; a complex K is read as that |
| ``io.read_mat_values``, a ReducedModel in .mat | ``.save``, `load`; `io.read_mat` by name |
| ``design_multirate``, ``design_input_estimator`` | gone: `design_kalman`, `plant.RandomWalk` |
| ``updating.sample_posterior`` | `UpdateResult.sample`, `UpdateResult.interval` |
| ``synthesis.shape_loop`` | `design_ncf` of a plant with weights; `tune_loops` |
| ``updating.Tikhonov``, ``updating.Lasso`` | priors of parameters; `localise` |
| ``placement.KineticEnergy``, ``AutoMac``, indices | `placement.ModeInformation`, `PoiVariance` |
| ``estimation.check_gain`` | gone: `KalmanEstimator.certificate` |
| ``placement.Mirrored``, ``placement.Penalised`` | a `placement.Constraint` of yours |
| ``plot.PolePicker``, ``plot.animate_mode`` | `plot.stabilisation`, `plot.mode_shape` |
| ``sparse.Pardiso`` | gone: hardly faster than the library's own factor; `sparse.Cholmod` |
| ``io.read_sierra`` | gone: save K, M as .mat or .mtx; `io.read_exodus_modes` stays |

**Licences.** flexplant has the MIT licence. At run time it needs NumPy, SciPy, python-control,
threadpoolctl and lazy-loader (BSD-3), cvxpy and Clarabel (Apache-2.0), filterpy (MIT), matplotlib
(its own licence, similar to BSD), and tqdm (MPL-2.0 and MIT). Extras are installed as in
``pip install -e '.[ansys]'``. The extra ``hdf5`` needs h5py and ``workbench`` needs panel (BSD-3),
``uff`` needs pyuff and ``ansys`` needs ansys-mapdl-reader (MIT), ``docs`` needs pdoc (MIT-0) and
latex2mathml (MIT). The dependencies of these packages have similar licences. slycot (GPL-2) and
other peers are used in tests only. Sources are cited by the keys of `flexplant.bibliography`; the
method is that of [paper]_. Its text says 0.1 % modal damping while its printed eigenvalues have 1
%; `examples/paper_plate.py` shows both.
"""

from importlib import import_module as _import_module
from typing import Any as _Any

from lazy_loader import attach_stub as _attach_stub

__version__ = "0.2.0"

# a room is imported when a name of it is first used: the names are in __init__.pyi
_imported, __dir__, __all__ = _attach_stub(__name__, __file__)


def __getattr__(name: str) -> _Any:
    """Import the room of a name at its first use; say of a wrong name where it is."""
    if name in __all__:
        return _imported(name)
    where = _import_module(".rooms", __name__).hint(name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}.{where}")
