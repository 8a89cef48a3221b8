"""Comparisons that cannot fail: an absolute tolerance as large as what is expected.

Gains here are 1e-9 m/N and variances 1e-20 m^2. `pytest.approx(1e-13)` accepts every number below
1e-12 and `np.allclose(x, 1e-9)` every one below 1e-8: such a test passes whatever the library
returns. `guard` wraps these functions, so that a test fails where it compares in this way.
"""

import functools
import inspect
import sys
from pathlib import Path

import numpy as np
import pytest

HERE = str(Path(__file__).parent)


def blunt(expected, absolute, given):
    """Return why a comparison with this absolute tolerance says nothing, or None.

    An array counts as a whole, by its largest finite entry. An expected zero can only be compared
    with an absolute tolerance, which the test has to state: `given`.
    """
    try:
        size = np.abs(np.asarray(expected, dtype=complex))
    except (TypeError, ValueError):
        return None  # text, None, ragged lists: not compared by tolerance
    size, absolute = size[np.isfinite(size)], float(np.max(absolute))
    if not size.size or not absolute:
        return None
    scale = float(size.max())
    if scale == 0:
        return None if given else f"zero is expected within the default of {absolute:g}"
    return None if scale > absolute else f"{scale:.3g} is expected within {absolute:.3g}"


def refuse(why):
    if why is not None:
        pytest.fail(
            f"{why}: such a comparison can hardly fail. State an absolute tolerance that means "
            "something for this quantity, or 0 for a relative one alone (abs=0, atol=0)."
        )


def called_by_a_test():
    """Whether the wrapper was called by a module of this folder."""
    return sys._getframe(2).f_code.co_filename.startswith(HERE)


def guarded_approx(approx):
    @functools.wraps(approx)
    def checked(expected, rel=None, abs=None, nan_ok=False):
        if called_by_a_test():
            # a relative tolerance alone does not switch the default of 1e-12 off
            absolute = 1e-12 if abs is None else abs
            for value in expected.values() if isinstance(expected, dict) else [expected]:
                refuse(blunt(value, absolute, abs is not None))
        return approx(expected, rel=rel, abs=abs, nan_ok=nan_ok)

    return checked


def guarded_numpy(function):
    signature = inspect.signature(function)
    default = signature.parameters["atol"].default

    @functools.wraps(function)
    def checked(*args, **options):
        if called_by_a_test():
            given = signature.bind(*args, **options).arguments
            expected = given["desired" if "desired" in given else "b"]
            refuse(blunt(expected, given.get("atol", default), "atol" in given))
        return function(*args, **options)

    return checked


def guard():
    """Wrap the comparisons for the session; those of the library and of others stay as they are."""
    pytest.approx = guarded_approx(pytest.approx)
    np.testing.assert_allclose = guarded_numpy(np.testing.assert_allclose)
    np.allclose = guarded_numpy(np.allclose)
    np.isclose = guarded_numpy(np.isclose)
