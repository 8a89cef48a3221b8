"""How long the import takes, beside NumPy and the parts of SciPy that it uses.

``python -m pytest -n 0 -m benchmark -s tests/benchmarks/test_import_benchmarks.py``, with
``OMP_NUM_THREADS=1``
"""

import subprocess
import sys

import pytest

from benchmarks.timing import best

pytestmark = pytest.mark.benchmark

PEERS = "import numpy, scipy.linalg, scipy.sparse.linalg"
OWN = {
    "import": "import flexplant",
    "import, NumPy and SciPy, a plant": f"{PEERS}; import flexplant as fx; fx.assemble_plant",
    "all rooms but plots": f"{PEERS}; import flexplant as fx; fx.testbeds; fx.placement; fx.joined",
}


def test_import_beside_numpy_and_scipy():
    def seconds(code):
        return best(lambda: subprocess.run([sys.executable, "-c", code], check=True), 7)[1]

    bare, peers = seconds("pass"), seconds(PEERS)
    print(f"\nPython alone {bare:.2f} s, {PEERS} {peers:.2f} s")
    for name, code in OWN.items():
        print(f"{name}: {seconds(code):.2f} s")
    assert seconds(OWN["import"]) - bare < 0.5
    assert seconds(OWN["import, NumPy and SciPy, a plant"]) - peers < 0.5
