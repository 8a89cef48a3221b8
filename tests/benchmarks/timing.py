"""How benchmarks take the time of a call."""

import time


def best(call, repeats=3):
    """Return what a call gave, and its shortest time [s]."""
    times = []
    for _ in range(repeats):
        start = time.perf_counter()
        result = call()
        times.append(time.perf_counter() - start)
    return result, min(times)
