"""CPU time of a sample and size of code of a controller in C, beside loops and scipy's sosfilt.

Run with ``-n 0 -m benchmark -s``. One controller of 60 states, 1 Hz to 2 kHz at 10 kHz, in full
matrices as a design leaves it.
"""

import shutil
import subprocess
import time

import numpy as np
import pytest
from scipy.signal import sosfilt

from flexplant.export import write_c
from flexplant.lti import StateSpace
from flexplant.synthesis import second_order_sections

COMPILER = shutil.which("cc") or shutil.which("gcc")
SAMPLES = 200_000
CLOCK = """
#include <stdio.h>
#include <time.h>
#include "stage.h"
int main(void)
{{
    static stage_t self;
    {real} in[{m}] = {{0}}, out[{p}];
    clock_t first;
    long k;
    stage_reset(&self);
    first = clock();
    for (k = 0; k < {samples}; ++k) {{
        in[0] = ({real})(k & 7);
        stage_step(&self, in, out);
    }}
    printf("%.9g %.9g\\n", (double)(clock() - first) / CLOCKS_PER_SEC / {samples}, (double)out[0]);
    return 0;
}}
"""
#: what one writes at first: four matrices, plain loops
PLAIN = """
typedef struct {{ double x[{n}]; }} stage_t;
void stage_reset(stage_t *self);
void stage_step(stage_t *self, const double *in, double *out);
"""
LOOPS = """
#include "stage.h"
{tables}
void stage_reset(stage_t *self) {{ int i; for (i = 0; i < {n}; ++i) self->x[i] = 0.0; }}
void stage_step(stage_t *self, const double *in, double *out)
{{
    double next[{n}];
    int i, j;
    for (i = 0; i < {p}; ++i) {{
        double sum = 0.0;
        for (j = 0; j < {n}; ++j) sum += C[i][j] * self->x[j];
        for (j = 0; j < {m}; ++j) sum += D[i][j] * in[j];
        out[i] = sum;
    }}
    for (i = 0; i < {n}; ++i) {{
        double sum = 0.0;
        for (j = 0; j < {n}; ++j) sum += A[i][j] * self->x[j];
        for (j = 0; j < {m}; ++j) sum += B[i][j] * in[j];
        next[i] = sum;
    }}
    for (i = 0; i < {n}; ++i) self->x[i] = next[i];
}}
"""


def controller(m, p, pairs=30):
    rng = np.random.default_rng(0)
    angle = 2 * np.pi * np.geomspace(1.0, 2000.0, pairs) / 1e4
    n, A = 2 * pairs, np.zeros((2 * pairs, 2 * pairs))
    for i, w in enumerate(angle):
        turn = np.array([[np.cos(w), np.sin(w)], [-np.sin(w), np.cos(w)]])
        A[2 * i : 2 * i + 2, 2 * i : 2 * i + 2] = np.exp(-0.05 * w) * turn
    Q = np.linalg.qr(rng.standard_normal((n, n)))[0]
    B, C = rng.standard_normal((n, m)), rng.standard_normal((p, n))
    return StateSpace(Q @ A @ Q.T, Q @ B, C @ Q.T, rng.standard_normal((p, m)), 1e-4)


def measured(folder, m, p, real="double", flags=("-O2",)):
    """CPU seconds a sample, bytes of code and constants, and the last output."""
    text = CLOCK.format(m=m, p=p, real=real, samples=SAMPLES)
    (folder / "main.c").write_text(text)
    flags = ["-std=c99", *flags]
    for command in (["-c", "stage.c"], ["stage.o", "main.c", "-o", "run"]):
        subprocess.run([COMPILER, *flags, *command], cwd=folder, check=True)
    answers = [
        subprocess.run(["./run"], cwd=folder, check=True, capture_output=True, text=True).stdout
        for _ in range(3)
    ]
    spent, out = min(tuple(map(float, answer.split())) for answer in answers)
    listed = subprocess.run(["size", "stage.o"], cwd=folder, check=True, capture_output=True)
    return spent, int(listed.stdout.split()[6]), out


def plain(folder, K):
    folder.mkdir()
    n, m, p = K.n_states, len(K.inputs), len(K.outputs)
    tables = "".join(
        f"static const double {name}[{len(M)}][{len(M[0])}] = {{"
        + ",".join("{" + ",".join(f"{v:.17g}" for v in row) + "}" for row in M)
        + "};\n"
        for name, M in (("A", K.A), ("B", K.B), ("C", K.C), ("D", K.D))
    )
    (folder / "stage.h").write_text(PLAIN.format(n=n))
    (folder / "stage.c").write_text(LOOPS.format(n=n, m=m, p=p, tables=tables))
    return folder


@pytest.mark.benchmark
@pytest.mark.skipif(COMPILER is None or shutil.which("size") is None, reason="no C compiler")
@pytest.mark.parametrize("shape", [(1, 1), (4, 4), (7, 4)])
def test_sixty_states_in_half_a_microsecond(shape, tmp_path):
    K = controller(*shape)
    rows = {}
    rows["plain loops -O2"] = measured(plain(tmp_path / "plain", K), *shape)
    rows["plain loops -O3 -ffast-math"] = measured(
        tmp_path / "plain", *shape, flags=("-O3", "-ffast-math")
    )
    for single, real in ((False, "double"), (True, "float")):
        folder = tmp_path / real
        folder.mkdir()
        write_c(K, folder / "stage.c", single=single)
        rows[f"write_c {real} -O2"] = measured(folder, *shape, real=real)
    sections = list(second_order_sections(K).values())
    given = np.arange(20_000) % 8.0
    first = time.process_time()
    for sos in sections:
        sosfilt(sos, given)
    rows["scipy.signal.sosfilt"] = (time.process_time() - first) / given.size, 0, np.nan
    for name, (spent, size, _) in rows.items():
        print(f"{shape} {name:28s} {1e6 * spent:7.3f} us {size:7d} bytes")
    assert rows["write_c double -O2"][2] == pytest.approx(rows["plain loops -O2"][2], rel=1e-8)
    assert rows["write_c float -O2"][2] == pytest.approx(rows["plain loops -O2"][2], rel=1e-2)
    assert rows["write_c double -O2"][0] < 0.5e-6
    for name, part in (("plain loops -O2", 0.25), ("scipy.signal.sosfilt", 1.0)):
        assert rows["write_c double -O2"][0] < part * rows[name][0]
    assert rows["write_c double -O2"][1] < 0.6 * rows["plain loops -O2"][1]
