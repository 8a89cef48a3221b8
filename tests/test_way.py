"""How much of the library one reads along the README's whole design: files with functions in it."""

import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
#: files at most whose functions "A whole design" executes, bands of machines that a fit allows
#: with the shapes measured included. The goal is 78: lower this with each file that leaves the way
FILES = 78

COUNT = """
import importlib, pkgutil, re, sys
from pathlib import Path
import flexplant

root = Path(flexplant.__file__).parent
for found in pkgutil.walk_packages([str(root)], "flexplant."):
    if not found.name.endswith("__main__"):
        importlib.import_module(found.name)  # class bodies are no functions on the way
text = Path("README.md").read_text(encoding="utf-8").partition("## A whole design")[2]
code = compile(re.search(r"```python\\n(.*?)```", text, re.DOTALL)[1], "README.md", "exec")
seen = set()
sys.setprofile(lambda frame, event, given: seen.add(frame.f_code.co_filename))
exec(code, {"__name__": "way"})
sys.setprofile(None)
print(*sorted(str(Path(name).relative_to(root)) for name in seen if name.startswith(str(root))))
"""


@pytest.mark.slow
@pytest.mark.long
def test_files_on_the_way():
    ran = subprocess.run(
        [sys.executable, "-c", COUNT], cwd=ROOT, capture_output=True, text=True, check=True
    )
    files = ran.stdout.splitlines()[-1].split()
    assert "plant/standard.py" in files and "plot/page.py" not in files
    assert len(files) <= FILES, files
