"""Files of others: in tests/data where their licence allows it, else where they are present."""

import os
from pathlib import Path

import pytest

#: what belongs to the project: see its README.md
BUNDLED = Path(__file__).parent / "data"
#: beside the project, or where FLEXPLANT_DATA says: GPL, or without a licence
ELSEWHERE = Path(os.environ.get("FLEXPLANT_DATA", Path(__file__).parents[2] / "shared" / "data"))


def data_file(place):
    """Return the path of a file or folder of the data, "fe/uff", which may not be there."""
    return BUNDLED / place if (BUNDLED / place).exists() else ELSEWHERE / place


def needs(path):
    """Return the mark of tests that are skipped without a file or folder of the data."""
    return pytest.mark.skipif(not path.exists(), reason=f"needs {path}")
