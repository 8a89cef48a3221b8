"""Files of others that tests read where they are present; they are not part of the project."""

import os
from pathlib import Path

import pytest

#: beside the project, or where FLEXPLANT_DATA says
DATA = Path(os.environ.get("FLEXPLANT_DATA", Path(__file__).parents[2] / "shared" / "data"))


def needs(path):
    """Return the mark of tests that are skipped without a file or folder of the data."""
    return pytest.mark.skipif(not path.exists(), reason=f"needs {path}")
