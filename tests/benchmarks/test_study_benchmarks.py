"""A study on two processes and on a local dask cluster; run with ``-n 0 -m benchmark -s``."""

import logging
import os
import time
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager, nullcontext
from functools import partial

import numpy as np
import pytest

import flexplant as fx

pytestmark = pytest.mark.benchmark
#: CPU time of one machine [s], and the number of machines
EACH, MACHINES = 0.3, 12
#: speed-up that is asked of two workers on two idle cores
ASKED = 1.7


def busy(machine, rng, each=EACH):
    """Use the processor for a time, and return a row."""
    begin = time.process_time()
    while time.process_time() - begin < each:
        largest = np.linalg.norm(rng.normal(size=(60, 60)), 2)
    return {"machine": float(machine), "positive": bool(largest > 0.0)}


@contextmanager
def of_dask():
    """Give the executor of a local cluster of two workers."""
    distributed = pytest.importorskip("distributed")
    with (
        distributed.LocalCluster(n_workers=2, threads_per_worker=1, dashboard_address=None) as own,
        distributed.Client(own) as client,
    ):
        yield client.get_executor()


def taken(executor):
    """Return the wall times [s] of a first small study, in which workers import, and of a study."""
    seconds = []
    for count, each in ((4, 0.01), (MACHINES, EACH)):
        begin = time.perf_counter()
        table = fx.study(range(count), partial(busy, each=each), executor=executor, rng=0)
        assert not any(table["failed"]) and table["machine"].tolist() == list(range(count))
        seconds.append(time.perf_counter() - begin)
    return seconds


def test_two_workers(caplog):
    """The speed-up over a plain loop, and workers that close without a word of being killed."""
    kinds = {"loop": nullcontext, "two processes": lambda: ProcessPoolExecutor(2), "dask": of_dask}
    first, seconds = {}, {}
    with caplog.at_level(logging.WARNING):
        for name, start in kinds.items():
            with start() as executor:
                first[name], seconds[name] = taken(executor)
    assert not [one for one in caplog.messages if "kill" in one.lower()]
    shown = ", ".join(
        f"{name} {s:.2f} s ({seconds['loop'] / s:.2f}, after {first[name]:.2f} s for its start)"
        for name, s in seconds.items()
    )
    print(f"\n{MACHINES} machines of {EACH} s of CPU: {shown}; load {os.getloadavg()[0]:.1f}")
    assert seconds["loop"] / seconds["two processes"] > ASKED
    assert seconds["loop"] / seconds["dask"] > ASKED
