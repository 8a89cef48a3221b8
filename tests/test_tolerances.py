"""The rule on tolerances refuses comparisons that cannot fail, and no others."""

import numpy as np
import pytest

from tolerances import blunt, guarded_approx, guarded_numpy

REFUSED = {
    "default of approx": lambda: pytest.approx(1e-13),
    "rel leaves the default of approx": lambda: pytest.approx(1e-13, rel=1e-3),
    "abs of approx": lambda: pytest.approx(0.5, abs=1.0),
    "one value of a dict": lambda: pytest.approx({"a": 1.0, "b": 1e-15}),
    "a list": lambda: pytest.approx([1e-13, -1e-14]),
    "zero without abs": lambda: pytest.approx(0.0),
    "default of allclose": lambda: np.allclose(1.0, [1e-9, 1e-10]),
    "default of isclose": lambda: np.isclose(1e-9, 1e-9j, rtol=1e-3),
    "zero without atol": lambda: np.allclose(np.ones(3), np.zeros(3)),
    "atol of assert_allclose": lambda: np.testing.assert_allclose(1.0, [[0.9], [-0.2]], 0.1, 2.0),
    "an atol for each entry": lambda: np.testing.assert_allclose(1.0, [1e-9, 0], atol=[1e-7, 0]),
}
ACCEPTED = {
    "relative": lambda: pytest.approx(1e-13, rel=1e-9, abs=0),
    "large": lambda: pytest.approx(1e-11),
    "zero with abs": lambda: pytest.approx(0.0, abs=1e-9),
    "zeros with atol": lambda: np.allclose(np.zeros(3), np.zeros(3), atol=1e-12),
    "small beside large": lambda: np.testing.assert_allclose([1, 0], [1.0, 1e-17], atol=1e-12),
    "no atol": lambda: np.testing.assert_allclose(1e-30, 1e-30),
    "not finite": lambda: np.isclose(np.inf, [np.inf, np.nan]),
    "nothing": lambda: np.allclose(np.zeros((0, 2)), np.zeros((0, 2))),
    "no number": lambda: pytest.approx(None),
    "atol by name": lambda: np.allclose(a=1.0, b=1e-9, rtol=0.1, atol=0.0),
}


@pytest.mark.parametrize("name", REFUSED)
def test_a_comparison_that_cannot_fail_is_refused(name):
    with pytest.raises(pytest.fail.Exception, match=r"expected within .*abs=0, atol=0"):
        REFUSED[name]()


@pytest.mark.parametrize("name", ACCEPTED)
def test_other_comparisons_are_left_alone(name):
    ACCEPTED[name]()


def test_only_tests_are_bound_by_the_rule():
    namespace = {"np": np, "pytest": pytest}
    elsewhere = compile("found = np.allclose(1.0, 1e-9), pytest.approx(0.0)", "lib.py", "exec")
    exec(elsewhere, namespace)
    assert namespace["found"] == (False, 0.0)


def test_wrappers_keep_what_they_wrap():
    for wrapped in (guarded_approx(pytest.approx), guarded_numpy(np.allclose)):
        assert wrapped.__doc__
    assert pytest.approx(2.0, rel=0.1) == 2.1
    assert np.isclose([1.0, np.nan], [1.0, np.nan], equal_nan=True).all()
    assert blunt("text", 1e-12, False) is None
