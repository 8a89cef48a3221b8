"""Parsers of other packages, run in a child process since a damaged file may crash them.

Nothing of this package is imported here: the process starts in a fraction of a second, and returns
plain arrays, texts and dicts only.
"""

from __future__ import annotations

import atexit
import os
import pickle
import subprocess
import sys
import warnings
from pathlib import Path
from typing import Any

#: number of bytes that a parser may use in addition to a multiple of the size of the file
_SPARE = 2**26
#: whether this process only runs parsers, so that its memory and time may be limited
ALONE = False


def matlab(path: str) -> dict[str, Any]:
    """Return {name: value} of a MATLAB file up to version 7; structures become dicts."""
    import scipy.io.matlab

    # compressed data expand at most a thousand times
    _bound_memory(path, 1100)
    content = scipy.io.matlab.loadmat(path, struct_as_record=False, spmatrix=False)
    return {name: _plain_value(value) for name, value in content.items() if name[:2] != "__"}


def ansys_full(path: str) -> dict[str, Any]:
    """Return the table of rows (node, DOF), K, M and the header of an ANSYS .full file."""
    from ansys.mapdl import reader

    _bound_memory(path, 60)
    full = reader.read_binary(path)
    if not hasattr(full, "load_km"):
        return {"class": type(full).__name__}
    head = full._header
    whole = {"nodes": int(head["nNodes"]), "of": int(head["GlbnNodes"])}
    if whole["nodes"] < whole["of"] or (head["distKey"] and not whole["of"]):
        return {"part": whole}
    table, K, M = full.load_km(sort=False)
    return {"table": table, "K": sound(K), "M": sound(M), "damped": bool(head["ptrDMP"])}


def ansys_mesh(path: str) -> dict[str, Any]:
    """Return node numbers, coordinates and nodal angles of an ANSYS .rst or .cdb file."""
    from ansys.mapdl import reader

    _bound_memory(path, 60)
    archive = path.lower().endswith(".cdb")
    mesh = reader.Archive(path, parse_vtk=False) if archive else reader.read_binary(path).mesh
    return {"nodes": mesh.nnum, "xyz": mesh.nodes, "angles": mesh.node_angles}


def ansys_modes(path: str) -> dict[str, Any]:
    """Return frequencies [Hz], shapes in global directions and nodes of an ANSYS .rst file."""
    import numpy as np
    from ansys.mapdl import reader

    _bound_memory(path, 60)
    results = reader.read_binary(path)
    whole = {"nodes": len(results.mesh.nnum), "of": int(results._resultheader["Glbnnod"])}
    if whole["nodes"] < whole["of"]:
        return {"part": whole}
    freq = np.asarray(results.time_values)
    solutions = [results.nodal_solution(step) for step in range(freq.size)]
    if any(not np.array_equal(ids, solutions[0][0]) for ids, _ in solutions):
        raise ValueError("the modes are at different nodes")
    return {
        "freq": freq,
        "ids": solutions[0][0],
        "shapes": np.array([shape for _, shape in solutions]),
        "kinds": [str(kind) for kind in results.result_dof(0)],
        "nodes": results.mesh.nnum,
        "xyz": results.mesh.nodes,
        "analysis": int(results._resultheader["kan"]),
        "cyclic": int(results._resultheader["nSector"]) > 1,
    }


def _plain_value(value: Any) -> Any:
    import numpy as np
    import scipy.sparse as sp

    fields = getattr(value, "_fieldnames", None)
    if fields is not None:
        return {name: _plain_value(getattr(value, name)) for name in fields}
    if sp.issparse(value):
        return sound(value)
    if isinstance(value, np.ndarray) and value.dtype == object:
        if value.size == 1 and hasattr(value.flat[0], "_fieldnames"):
            return _plain_value(value.flat[0])
        cells = np.empty(value.shape, dtype=object)
        for place in np.ndindex(value.shape):
            cells[place] = _plain_value(value[place])
        return cells
    return np.array(value) if isinstance(value, np.ndarray) else value


def sound(matrix: Any) -> Any:
    """Return a sparse matrix with checked pointers and indices, anything else unchanged."""
    # damaged ones make SciPy write outside of its arrays; its own check passes over empty matrices
    import numpy as np

    if hasattr(matrix, "indptr"):
        if np.any(np.diff(matrix.indptr) < 0):
            raise ValueError("pointers of columns decrease")
        matrix.check_format(full_check=True)
    return matrix


def _bound_memory(path: str, times: int) -> None:
    """Bound the memory that may still be taken, by the size of the file, where the system can."""
    if not ALONE:
        return
    try:
        import resource

        size, used = os.path.getsize(path), resource.getrusage(resource.RUSAGE_SELF)
        pages = int(Path("/proc/self/statm").read_text().split()[5])
        most = pages * resource.getpagesize() + _SPARE + times * size
        seconds = int(used.ru_utime + used.ru_stime) + 60 + size // 10**6
        for what, limit in ((resource.RLIMIT_DATA, most), (resource.RLIMIT_CPU, seconds)):
            hard = resource.getrlimit(what)[1]
            within = limit if hard == resource.RLIM_INFINITY else min(limit, hard)
            resource.setrlimit(what, (within, hard))
    except (ImportError, OSError, ValueError, IndexError):
        return


def run(name: str, path: str) -> tuple[str, Any]:
    """Return ("value", value) of a function of this module, or the name and text of its error."""
    try:
        with warnings.catch_warnings(action="ignore"):
            return "value", globals()[name](path)
    except Exception as error:
        return type(error).__name__, str(error)


def outcome_of(request: tuple[list[str], str, str]) -> bytes:
    """Return the pickled outcome of a request (sys.path, function, file)."""
    sys.path[:], name, path = request
    try:
        return pickle.dumps(run(name, path), protocol=5)
    except Exception as error:
        return pickle.dumps((type(error).__name__, str(error)))


def main() -> None:
    """Answer requests from the input until it ends."""
    global ALONE
    ALONE = True
    answers = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)  # what the parsers print
    while True:
        try:
            request = pickle.load(sys.stdin.buffer)
        except EOFError:
            return
        answers.write(outcome_of(request))
        answers.flush()


#: children that wait for the next file, by the process that started them and their package
_WAITING: dict[tuple[int, str], subprocess.Popen[bytes]] = {}


def in_child(function: str, path: str | Path, *, keep: str = "") -> tuple[str, Any]:
    """Return ("value", value) of a function of this module, or the name and the text of its error.

    A damaged file may make a parser crash, take all memory or never end: in a separate process,
    with bounds, this gives a normal error. Where no Python interpreter can be started (a frozen or
    embedded program), the function runs in this process.
    """
    file = Path(path)
    if not file.is_file():
        raise FileNotFoundError(f"no such file: {str(file)!r}")
    key = (os.getpid(), keep)
    # removed while it is used: another thread starts its own child
    child = _WAITING.pop(key, None)
    if child is not None and child.poll() is not None:
        _close(child)
        child = None
    child = child or _start_child()
    if child is None:
        return run(function, str(file))
    assert child.stdin is not None and child.stdout is not None  # noqa: S101 - both are pipes
    try:
        pickle.dump(([*sys.path], function, str(file.absolute())), child.stdin)
        child.stdin.flush()
        outcome: tuple[str, Any] = pickle.load(child.stdout)
    except (OSError, EOFError, pickle.UnpicklingError):
        _close(child)
        return "crash", f"its parser ended with code {child.returncode}"
    except BaseException:  # interrupted: the answer would arrive for the next file
        child.kill()
        _close(child)
        raise
    old = _WAITING.pop(key, None) if keep else child
    if keep:
        _WAITING[key] = child
    if old is not None:
        _close(old)
    return outcome


def _start_child() -> subprocess.Popen[bytes] | None:
    """Return a new child process; None where no Python interpreter can be started."""
    if "python" not in Path(sys.executable or "").name.lower():
        return None
    # -P: the folder of the script, whose modules have names of the standard library, stays out
    command, pipe = [sys.executable, "-P", __file__], subprocess.PIPE
    env = os.environ | {"OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1"}
    try:
        return subprocess.Popen(
            command, stdin=pipe, stdout=pipe, stderr=subprocess.DEVNULL, env=env
        )
    except OSError:
        return None


def _close(child: subprocess.Popen[bytes]) -> None:
    """End a child that has nothing to do: it ends when its input does."""
    for pipe in (child.stdin, child.stdout):
        try:
            if pipe is not None:
                pipe.close()
        except OSError:
            continue
    child.wait()


@atexit.register
def _close_all() -> None:
    for (process, _), child in _WAITING.items():
        if process == os.getpid():
            _close(child)


if __name__ == "__main__":
    main()
