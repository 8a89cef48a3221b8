"""A controller in C at 10 kHz in one process, the machine in another.

Run it: ``python examples/real_time.py``; it needs a C compiler and POSIX shared memory, but no
special rights and no real-time kernel. Observer, servo and feedforward are designed on a model,
exported as C code, and control a virtual machine that is computed with another theory and also runs
in C. In each sample the machine waits for the sampling instant and writes its sensors; the
controller writes its commands; then the machine continues with these commands. A late command
delays the sample, so that the motion equals that of `simulate` on any computer, however busy. The
delays of samples and commands are measured. On two cores that other programs used too [us]::

                   median     99 %   99.9 %  largest
    sample late       1.9      3.7     76.3  11840.6
    answer after      6.4     13.3     43.9    244.8
"""

# %% Names and numbers
import os
import shutil
import subprocess
import tempfile
from pathlib import Path
from typing import Any

import numpy as np

import flexplant as fx
from flexplant.export import write_c

OUT = Path(globals().get("__file__", ".")).parent / "out"  # "." in a notebook
RATE, BANDWIDTH, DAMPING, L = 10e3, 50.0, 0.01, 0.6  # Hz, Hz, 1, m
MOVE = fx.setpoint(100e-6, velocity=5e-3, acceleration=0.5, jerk=100.0, rest=0.05, rate=RATE)
COMPILER = next(filter(None, map(shutil.which, ("cc", "gcc", "clang"))), None)
LIMIT = 20.0  # N


# %% The design, on a model
def design() -> fx.ClosedLoop:
    """Return the loop on the virtual machine, designed on a model."""
    plate = fx.kirchhoff_plate(
        size=(L, L), thickness=0.0272, elements=(8, 8), density=2702, youngs_modulus=70e9,
        poisson_ratio=0.35,
    )  # fmt: skip
    hidden = fx.PointMass(plate.dofs.nearest((L / 2, L / 4, 0.0), "z"), 0.5)  # was identified
    modes = fx.solve_modes(plate.with_parts(hidden), count=24, damping=fx.ModalDamping(DAMPING))
    corners = [(x, y, 0.0) for y in (0.0, L) for x in (0.0, L)]
    inset = [(x, y, 0.0) for y in (L / 4, 3 * L / 4) for x in (L / 4, 3 * L / 4)]
    ports = fx.Ports(
        w=[fx.Disturbance(f"amp{i}", at=p, asd=1e-3) for i, p in enumerate(inset, 1)],
        u=[fx.Actuator(f"u{i}", at=p) for i, p in enumerate(inset, 1)],
        z=[fx.Poi("die", at=(L / 2, L / 2, 0.0), axes=("z", "rx", "ry"))],
        y=[fx.Sensor(f"y{i}", at=p, asd=1.4e-12) for i, p in enumerate(corners, 1)],
        references=[fx.Reference("die")],
    )
    plant = fx.assemble_plant(modes, ports).discretized(RATE, delay=1.3)
    observer = fx.design_kalman(plant)
    servo = fx.design_servo(plant, bandwidth=BANDWIDTH, observer=observer)
    model = fx.close_loop(plant, observer, servo)
    forward = fx.design_feedforward(model).up_to("acceleration")
    return fx.testbeds.wafer_stage(damping=DAMPING).loop(ports, observer, servo, forward)


# %% The two programs: what they share is one file in memory
SHARED = """
#define _POSIX_C_SOURCE 200809L
#include <fcntl.h>
#include <sched.h>
#include <stdatomic.h>
#include <stdio.h>
#include <stdlib.h>
#include <sys/mman.h>
#include <time.h>
#include <unistd.h>
#include "machine.h"
#include "law.h"
#define NW (MACHINE_INPUTS - LAW_DRIVEN)
#define NZ (MACHINE_OUTPUTS - LAW_INPUTS)
typedef struct { double late, answer, out[MACHINE_OUTPUTS], u[LAW_OUTPUTS]; } record;
typedef struct {
    atomic_ulong sent, answered; /* samples */
    double y[LAW_INPUTS], u[LAW_OUTPUTS];
    char rest[]; /* w of all samples, then their records */
} shared;
static double now(void)
{
    struct timespec t;
    clock_gettime(CLOCK_MONOTONIC, &t);
    return (double)t.tv_sec + 1e-9 * (double)t.tv_nsec;
}
static shared *opened(const char *name, size_t size)
{
    const int file = open(name, O_RDWR);
    const int both = PROT_READ | PROT_WRITE;
    void *at = file < 0 ? MAP_FAILED : mmap(NULL, size, both, MAP_SHARED, file, 0);
    if (at == MAP_FAILED) { perror(name); exit(1); }
    return (shared *)at;
}
/* yields while it waits: on a busy computer the other process may need this core */
static void await(atomic_ulong *count, unsigned long wanted)
{
    while (atomic_load(count) < wanted) sched_yield();
}
int main(int argc, char **argv)
{
    const unsigned long samples = argc > 3 ? strtoul(argv[3], NULL, 10) : 0;
    const size_t size = argc > 2 ? strtoul(argv[2], NULL, 10) : 0;
    shared *s = opened(argc > 1 ? argv[1] : "", size);
    unsigned long k;
    alarm(600); /* ends a program whose partner has ended */
"""
CONTROLLER = """
    static law_t law;
    double out[LAW_OUTPUTS];
    int i;
    law_reset(&law);
    for (k = 0; k < samples; ++k) {
        await(&s->sent, k + 1);
        law_output(&law, s->y, out);
        for (i = 0; i < LAW_OUTPUTS; ++i) s->u[i] = out[i];
        law_update(&law, s->y); /* y stays until this sample is answered */
        atomic_store(&s->answered, k + 1);
    }
    return 0;
}
"""
MACHINE = """
    static machine_t machine;
    const double *w = (const double *)(const void *)s->rest;
    record *records = (record *)(void *)(s->rest + samples * NW * sizeof(double));
    double in[MACHINE_INPUTS] = {0}, next = now() + 0.01;
    int i;
    machine_reset(&machine);
    for (k = 0; k < samples; ++k) {
        record *r = &records[k];
        double woken;
        while (now() < next) sched_yield(); /* a sleep of 100 us ends 50 us late */
        woken = now();
        r->late = woken - next;
        for (i = 0; i < NW; ++i) in[i] = w[k * NW + (unsigned long)i];
        machine_output(&machine, in, r->out); /* sensors do not depend on u of this sample */
        for (i = 0; i < LAW_INPUTS; ++i) s->y[i] = r->out[NZ + i];
        atomic_store(&s->sent, k + 1);
        await(&s->answered, k + 1);
        r->answer = now() - woken;
        for (i = 0; i < LAW_DRIVEN; ++i) in[NW + i] = s->u[i];
        for (i = 0; i < LAW_OUTPUTS; ++i) r->u[i] = s->u[i];
        machine_output(&machine, in, r->out);
        machine_update(&machine, in);
        next += PERIOD;
        if (now() > next) next = now(); /* a sample was lost: time goes on from here */
    }
    return 0;
}
"""


def programs(loop: fx.ClosedLoop, folder: Path) -> list[Path]:
    """Return the machine and the controller of a loop, compiled."""
    plant = loop.plant
    g = plant.system.select(outputs=[*plant.z, *plant.y])
    g = g.select(inputs=[*plant.w, *loop.driven])
    g = g.renamed(outputs={name: f"{name}|y" for name in plant.y if name in plant.w})
    write_c(g, folder / "machine.c")
    write_c(loop, folder / "law.c", limits=LIMIT)
    made = []
    for name, text in (("machine", MACHINE), ("law", CONTROLLER)):
        main = folder / f"{name}_main.c"
        main.write_text(f"#define PERIOD {plant.dt!r}\n{SHARED}{text}")
        made.append(folder / f"run_{name}")
        command = ["-std=c11", "-O2", str(main), str(folder / f"{name}.c"), "-o", str(made[-1])]
        subprocess.run([str(COMPILER), *command], check=True)
    return made


# %% The run
def run(loop: fx.ClosedLoop, move: Any, duration: float) -> dict[str, Any]:
    """Return times and channels of a run of both processes."""
    plant = loop.plant
    samples = round(duration * RATE)
    w = np.zeros((samples, len(plant.w)))
    at = move.at(np.arange(samples) / RATE)
    w[:, plant.w.index("die:ref")] = at.position
    for derivative in ("velocity", "acceleration", "jerk", "snap"):
        if (name := f"die:ref:{derivative}") in plant.w:  # inputs of the feedforward
            w[:, plant.w.index(name)] = getattr(at, derivative)
    shown = (*plant.z, *plant.y, *loop.driven, *loop.watched)
    head, width = 16 + 8 * (len(plant.y) + len(loop.controller.outputs)), 2 + len(shown)
    memory = Path("/dev/shm") if os.access("/dev/shm", os.W_OK) else None
    with tempfile.TemporaryDirectory(dir=memory) as place:
        folder = Path(place)
        commands = programs(loop, folder)
        file = folder / "shared"
        size = head + 8 * samples * (w.shape[1] + width)
        file.write_bytes(bytes(head) + w.tobytes() + bytes(8 * samples * width))
        started = [
            subprocess.Popen([str(one), str(file), str(size), str(samples)])
            for one in reversed(commands)
        ]
        try:
            ends = [one.wait(timeout=500.0) for one in started]
        finally:
            for one in started:
                one.kill()
        if any(ends):
            raise RuntimeError(f"the programs ended with {ends}")
        records = np.fromfile(file, offset=head + w.nbytes).reshape(samples, width)
    channels = dict(zip(shown, records[:, 2:].T, strict=True))
    return {"late": records[:, 0], "answer": records[:, 1], "channels": channels}


def main(duration: float = 1.0) -> dict[str, Any]:
    """Return the run of the processes, and that of `simulate`."""
    loop = design()
    wanted = fx.simulate(loop, reference=MOVE, duration=duration, noise=False)
    return {"loop": loop, "wanted": wanted, **run(loop, MOVE, duration)}


def difference(result: dict[str, Any]) -> float:
    """Return the largest difference from `simulate` over the commands and errors, relative."""
    names = (*result["loop"].driven, "die:error")
    pairs = [(result["channels"][name], result["wanted"][name]) for name in names]
    return float(max(np.abs(a - b).max() / np.abs(b).max() for a, b in pairs))


def table(result: dict[str, Any]) -> str:
    """Return all numbers as text."""
    lines = [f"{'[us]':14s}" + "".join(f"{h:>9s}" for h in ("median", "99 %", "99.9 %", "largest"))]
    for label, name in (("sample late", "late"), ("answer after", "answer")):
        parts = np.percentile(1e6 * result[name], [50.0, 99.0, 99.9, 100.0])
        lines.append(f"{label:14s}" + "".join(f"{part:9.1f}" for part in parts))
    lost = int(np.sum(result["late"] + result["answer"] > 1.0 / RATE))
    lines.append(f"{lost} of {result['late'].size} answers came after their sample's end")
    lines.append(f"largest difference from simulate: {difference(result):.1e}")
    return "\n".join(lines)


def picture(result: dict[str, Any], folder: Path = OUT) -> Path:
    """Draw how late samples and answers are, and the error at the die."""
    import matplotlib.pyplot as plt

    figure, (left, right) = plt.subplots(1, 2, figsize=(13, 4.5), layout="constrained")
    for k, (name, label) in enumerate({"late": "sample late", "answer": "answer after"}.items()):
        values = np.sort(1e6 * result[name])
        part = 1.0 - np.arange(values.size) / values.size
        left.loglog(values, part, label=label, **fx.plot.CYCLE[k])
    left.axvline(1e6 / RATE, label="one sample", **fx.plot.STYLES["bound"])
    left.set(xlabel="time [µs]", ylabel="part of samples above", title="Two processes at 10 kHz")
    left.legend(frameon=False)
    left.grid(alpha=0.3)
    wanted, name = result["wanted"], "die:error"
    own = fx.Response(wanted.time, [result["channels"][name]], [name], {name: wanted.units[name]})
    for label, run in {"simulate": wanted, "the two processes": own}.items():
        fx.plot.response(run, [name], span=(0.0, 0.25), label=label, ax=right)
        right.get_lines()[0].set(linewidth=4.0, alpha=0.4)  # where both are equal both show
    right.set(
        title="A move of 100 µm", ylabel=right.get_ylabel().replace("error", "error at the die")
    )
    folder.mkdir(exist_ok=True)
    figure.savefig(folder / "real_time.png", dpi=90)
    plt.close("all")
    return folder / "real_time.png"


# %% Run it
if __name__ == "__main__":
    import matplotlib as mpl

    mpl.use("Agg")
    outcome = main()
    print(table(outcome), picture(outcome), sep="\n\npicture: ")
