"""Datasets 2414 of universal files, by the columns of their description."""

import numpy as np


def analysis(kind, values, *, load=0, mode=0, freq=0.0, result=8, real=(), location=1):
    """One dataset 2414 in its fixed columns; complex numbers take two fields."""
    values = np.asarray(values)
    flat = np.stack([values.real, values.imag], -1) if np.iscomplexobj(values) else values
    data, motion = (6 if np.iscomplexobj(values) else 4), {3: 2, 6: 3}[values.shape[1]]
    real = [0.0, freq, *real, *[0.0] * (10 - len(real))]
    lines = ["    -1", "  2414", f"{7:10d}", "a result", f"{location:10d}", *["NONE"] * 5]
    lines.append("".join(f"{n:10d}" for n in (1, kind, motion, result, data, values.shape[1])))
    lines.append("".join(f"{n:10d}" for n in (0, 0, 1, 0, load, mode, 0, 0)))
    lines.append(f"{0:10d}{0:10d}")
    lines += ["".join(f"{x:13.5E}" for x in part) for part in (real[:6], real[6:])]
    for node, row in zip((9, 4), flat.reshape(2, -1), strict=True):
        lines.append(f"{node:10d}")
        lines += ["".join(f"{x:13.5E}" for x in row[k : k + 6]) for k in range(0, row.size, 6)]
    return "\n".join([*lines, "    -1\n"])
