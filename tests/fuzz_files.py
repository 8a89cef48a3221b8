"""Damages small valid files of every format and reads them: `fuzz_files.py SECONDS [reader]`.

Each reader is tried in a process of its own for SECONDS of CPU time, its children counted. Printed
is a JSON line a reader: how many files, how many were still read, foreign errors, a crash, memory.
"""

import contextlib
import gzip
import json
import os
import pickle
import re
import resource
import sys
import tempfile
import traceback
import warnings
import zipfile
from functools import partial
from io import BytesIO
from pathlib import Path

import numpy as np
import scipy.io as sio
import scipy.sparse as sp

import flexplant as fx
from flexplant import io
from flexplant.errors import FlexplantError
from flexplant.io import ansys, foreign_parsers
from flexplant.io import mat_matrices as mat_variables
from flexplant.io.nastran import read_nodes

sys.path.insert(0, str(Path(__file__).parent))
from op2_files import op2, punch
from uff_files import analysis

RNG = np.random.default_rng(0)
K = np.diag([4.0, 5.0, 6.0, 7.0, 8.0]) - np.eye(5, k=1) - np.eye(5, k=-1) + RNG.normal() * 0
WHOLE = (0, 1, -1, 2, 7, 8, 64, 2**15, 2**16, 2**24, 2**30, 2**31 - 1, -(2**31), 2**40, 2**62)
WORDS = (
    *(
        b"",
        b"-1",
        b"0",
        b"1",
        b"1e5",
        b"3",
        b"99999999",
        b"2147483648",
        b"16777216",
        b"nan",
        b"inf",
    ),
    *(b"1e400", b"x", b"\xff", b" ", b"1.5D+03", b"-", b"1 2", b"**", b"4294967297", b"9" * 30),
)


def saved(write, *args, **kwargs):
    """What a writer of files writes."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "file.bin"
        write(path, *args, **kwargs)
        return path.read_bytes()


def matrix_market():
    i, j = np.nonzero(np.tril(K))
    rows = "".join(f"{a + 1} {b + 1} {K[a, b]:.12e}\n" for a, b in zip(i, j, strict=True))
    listed = f"%%MatrixMarket matrix coordinate real symmetric\n% a comment\n5 5 9\n{rows}".encode()
    whole = b"%%MatrixMarket matrix array real general\n2 2\n1.5\n2\n3\n4.25\n"
    return [listed, whole]


def harwell_boeing():
    return [saved(sio.hb_write, sp.csc_array(K))]


def matlab(compress=False):
    content = {
        "K": sp.csc_array(K),
        "M": np.eye(5),
        "model": {"K0": K, "name": "a beam", "cells": np.array([1, "b"], dtype=object)},
    }
    new = saved(sio.savemat, content, do_compression=compress)
    return [new, saved(sio.savemat, {"K": sp.csc_array(K), "M": np.eye(5)}, format="4")]


def matlab73():
    import h5py

    def write(path):
        with h5py.File(path, "w", userblock_size=512) as file:
            file["M"] = K
            group = file.create_group("K")
            group.attrs["MATLAB_sparse"] = 5
            matrix = sp.csc_array(K)
            for name, part in (("data", "data"), ("ir", "indices"), ("jc", "indptr")):
                group[name] = getattr(matrix, part)

    return [saved(write)]


def numpy_files():
    whole = BytesIO()
    np.savez(whole, K=K, M=np.eye(5))
    one = BytesIO()
    np.save(one, K)
    sparse = BytesIO()
    sp.save_npz(sparse, sp.csc_array(K), compressed=False)
    return [whole.getvalue(), sparse.getvalue(), one.getvalue()]


def op4(binary):
    """Dense and sparse, real and complex, in the form of the file."""
    with np.printoptions():
        from pyyeti.nastran import op4 as peer
    given = {"KAA": K, "MAA": np.eye(5), "C": K[:3] * (1 + 2j)}
    kinds = ("dense", "bigmat", "nonbigmat")
    return [
        saved(lambda p, k=kind: peer.write(p, given, binary=binary, sparse=k)) for kind in kinds
    ]


def dmig():
    head = "DMIG    KAAX           0       6       2       0                       5\n"
    cards = [head]
    for j in range(5):
        cards.append(f"DMIG*   KAAX            {j + 11:16d}               3\n")
        cards += [
            f"*       {i + 11:16d}               3{K[i, j]:16.9E}\n"
            for i in range(j + 1)
            if K[i, j]
        ]
    return ["".join(cards).encode()]


def bulk():
    text = """$ bulk
CORD2C  7       0       0.0     0.0     0.0     0.0     0.0     1.0
        1.0     0.0     0.0
GRID    11      7       1.0     90.0    0.0     7
GRID,12,,1.,2.,3.
SPOINT  21      THRU    25
GRID*                 13                              1.             2.0
*                     3.
ENDDATA
"""
    return [text.encode()]


def abaqus():
    i, j = np.nonzero(np.tril(K))
    pairs = list(zip(i, j, strict=True))
    named = "".join(f"{a + 1},3, {b + 1},3, {K[a, b]:.15e}\n" for a, b in pairs)
    plain = "".join(f"{a + 1} {b + 1} {K[a, b]:.15e}\n" for a, b in pairs)
    return [named.encode(), plain.encode()]


def exodus(make=None):
    def write(path):
        with sio.netcdf_file(path, "w") as file:
            file.createDimension("time_step", None)
            for name, size in (("num_nodes", 3), ("len_name", 33), ("num_nod_var", 1)):
                file.createDimension(name, size)
            for axis in "xyz":
                file.createVariable(f"coord{axis}", "d", ("num_nodes",))[:] = 1.5
            file.createVariable("node_num_map", "i", ("num_nodes",))[:] = [7, 3, 9]
            table = np.zeros((1, 33), "S1")
            table[0, :5] = list("DispZ")
            file.createVariable("name_nod_var", "c", ("num_nod_var", "len_name"))[:] = table
            file.createVariable("time_whole", "d", ("time_step",))[:2] = [10.0, 20.0]
            shape = file.createVariable("vals_nod_var1", "d", ("time_step", "num_nodes"))
            shape[:2] = [[1, 2, 3], [4, 5, 6.5]]

    def write_hdf(path):
        import h5py

        with h5py.File(path, "w") as file:
            for axis in "xyz":
                file[f"coord{axis}"] = [1.0, 2.0, 3.0]
            file["name_nod_var"] = np.array([[b"D", b"i", b"s", b"p", b"Z", b"\0"]])
            file["time_whole"] = [10.0, 20.0]
            file["vals_nod_var1"] = [[1.0, 2, 3], [4, 5, 6.5]]

    return [saved(make or write)] if make is None else [saved(write_hdf)]


def uff(binary=0):
    import pyuff

    freq = np.arange(1, 9) * 0.5
    fields = {
        "type": 58, "binary": binary, "func_type": 4, "rsp_node": 2, "rsp_dir": 3, "ref_node": 2,
        "ref_dir": 3, "data": freq * (1 + 2j), "x": freq, "id1": "id1", "rsp_ent_name": "NONE",
        "ref_ent_name": "NONE", "abscissa_spacing": 1, "abscissa_spec_data_type": 18,
        "ordinate_spec_data_type": 12, "orddenom_spec_data_type": 13,
        "abscissa_axis_units_lab": "Hz", "ordinate_axis_units_lab": "m/s^2",
        "orddenom_axis_units_lab": "N", "orddenom_len_unit_exp": 0, "z_axis_value": 0,
    }  # fmt: skip
    return [saved(lambda path: pyuff.UFF(str(path)).write_sets([fields]))]


def uff_records(kind=1):
    import pyuff

    fields = {
        "type": 58, "func_type": kind, "rsp_node": 2, "rsp_dir": 3, "ref_node": 2, "ref_dir": 3,
        "data": RNG.normal(size=20) ** 2, "x": np.arange(20.0) / 10, "abscissa_spacing": 1,
        "abscissa_inc": 0.1, "abscissa_spec_data_type": 17, "ordinate_spec_data_type": 12,
        "orddenom_spec_data_type": 0, "ordinate_axis_units_lab": "g^2/Hz" if kind == 9 else "g",
    }  # fmt: skip
    return [saved(lambda path: pyuff.UFF(str(path)).write_sets([fields]))]


def logger(mark, point):
    rows = [[0.01 * k, *RNG.normal(size=2)] for k in range(20)]
    table = [mark.join(f"{x:.4f}".replace(".", point) for x in row) for row in rows]
    return "\n".join(["Device", mark.join(["Time [s]", "F [N]", "a [g]"]), *table]).encode()


def labview(columns):
    end, count = "***End_of_Header***", 4 if columns == "Multi" else 3
    head = ["LabVIEW Measurement", "Separator\tTab", "X_Columns\t" + columns, end]
    head += ["Channels\t2", "Samples\t9\t9", "Y_Unit_Label\tN\tg", "X0\t0.0\t0.0"]
    head += ["Delta_X\t0.01\t0.01", end, "\t".join("XaYb"[:count])]
    rows = ["\t".join(f"{x:.4f}" for x in RNG.normal(size=count)) for _ in range(9)]
    return "\n".join([*head, *rows, ""]).encode()


def uff_shapes():
    import pyuff

    def column(kind, first):
        return np.array([first, 2.0]) * (1 + 0j if kind == 3 else 1)

    nodes = {"type": 15, "node_nums": [1, 2], "def_cs": [0, 5], "disp_cs": [6, 5], "color": [1, 1]}
    nodes |= {axis: [0.0, 1.0] for axis in "xyz"}
    turned = np.array([[0.0, 1, 0], [-1, 0, 0], [0, 0, 1], [0.5, 0.25, 0.125]])
    systems = [
        {
            "type": 2420, "CS_sys_labels": [5], "CS_types": [0], "CS_colors": [8],
            "CS_names": ["a"], "CS_matrices": [turned],
        },
        {
            "type": 18, "cs_num": [6], "cs_type": [0], "ref_cs_num": [5], "cs_name": ["b"],
            "ref_o": [[0.5, 0, 0]], "x_point": [[0.5, 0, 1]], "xz_point": [[1, 0, 0]],
        },
    ]  # fmt: skip
    shapes = [
        {
            "type": 55, "model_type": 1, "analysis_type": kind, "data_ch": 3, "spec_data_type": 8,
            "data_type": 5 if kind == 3 else 2, "r1": column(kind, 1.0),
            "r2": column(kind, 0.5), "r3": column(kind, 0.25),
            "n_data_per_node": 3, "node_nums": np.array([1, 2]), "load_case": 1, "mode_n": kind,
            "freq": 12.5, "modal_m": 1.0, "modal_damp_vis": 0.01, "modal_damp_his": 0.0,
            "eig": -1 + 80j, "modal_a": 1 + 0j, "modal_b": 1 + 0j,
        }
        for kind in (2, 3)
    ]  # fmt: skip
    return [saved(lambda path: pyuff.UFF(str(path)).write_sets([*systems, nodes, *shapes]))]


def uff_analysis(kind):
    rows = [f"{n:10d}{0:10d}{0:10d}{1:10d}{0.5:13.5E}{n:13.5E}{2.0:13.5E}\n" for n in (9, 4)]
    nodes = "".join(["    -1\n    15\n", *rows, "    -1\n"]).encode()
    values = RNG.normal(size=(2, 6)) * (1 + (1j if kind == 5 else 0))
    sets = [analysis(kind, values, mode=k, load=1, freq=10.0 * k, real=(0.0, 1.0)) for k in (1, 2)]
    return [nodes + "".join(sets).encode()]


def dofs_table():
    return [b"node,direction,x,y,z\n1,z,0.0,1.0,2.0\n2,rx,0.5,1.5,2.5\n3,UY,1e-3,2,3\n"]


def responses():
    return fx.Frf([1.0, 2.0, 4.0], np.ones((1, 2, 3)) * (1 + 2j), outputs=["y"], inputs=["a", "b"])


def frf_npz():
    file = BytesIO()
    np.savez(file, freq=[1.0, 2.0], data=[0.5, 0.25j], quantity="velocity", inputs=["u"])
    return [file.getvalue()]


def example(name):
    from ansys.mapdl.reader import examples

    return [(Path(examples.__file__).parent / name).read_bytes()]


def system():
    g = fx.StateSpace(-np.eye(2), np.ones((2, 1)), np.ones((1, 2)), [[0.0]], inputs=["u"])
    return [saved(io.write_mat, g)]


def full_with_nodes(path):
    return io.read_ansys(example_full(), nodes=path)


def example_full():
    from ansys.mapdl.reader import examples

    return examples.fullfile


def exodus_modes(path):
    return io.read_exodus_modes(path, rigid_below=1e-9)


def frf_mat():
    return [saved(sio.savemat, {"freq": [1.0, 2], "data": [1j, 2]})]


def modes_of(path, **options):
    return io.read_modes(path, zeta=0.01, rigid_below=1e-3, **options)


def result_file(*, punched=False):
    xyz, values = {7: (0.0, 0.0, 0.0), 9: (0.5, 0.25, 0.0)}, RNG.normal(size=(2, 2, 6))
    if punched:
        return [punch(values, [4.0, 9.0], list(xyz)).encode()]
    given = (xyz, {9: 5}, values, [4.0, 9.0], [1.0, 2.0])
    return [op2(*given), op2(*given, size=8), op2(*given, order=">")]


def punched_modes(path):
    (path.parent / "n.csv").write_text("node,x,y,z\n7,0,0,0\n9,1,0,0\n")
    return modes_of(path, nodes=path.parent / "n.csv")


#: {reader: (name of the file, valid contents, the call)}
READERS = {
    "matrix_market": ("K.mtx", matrix_market, io.read_matrix_market),
    "matrix_market_gz": ("K.mtx.gz", matrix_market, io.read_matrix_market),
    "harwell_boeing": ("K.rua", harwell_boeing, io.read_harwell_boeing),
    "matlab": ("K.mat", matlab, io.read_matlab),
    "matlab73": ("K.mat", matlab73, io.read_matlab),
    "npz": ("K.npz", numpy_files, io.read_npz),
    "op4_binary": ("K.op4", partial(op4, True), io.read_op4_matrices),
    "op4_text": ("K.op4", partial(op4, False), io.read_op4_matrices),
    "dmig": ("K.pch", dmig, io.read_dmig),
    "bulk": ("K.bdf", bulk, read_nodes),
    "abaqus": ("K.mtx", abaqus, io.read_abaqus),
    "exodus": ("m.exo", exodus, exodus_modes),
    "exodus_hdf5": ("m.exo", partial(exodus, True), exodus_modes),
    "op2": ("m.op2", result_file, modes_of),
    "punch": ("m.pch", partial(result_file, punched=True), punched_modes),
    "uff_modes": ("m.unv", uff_shapes, modes_of),
    "ansys_rst": ("m.rst", partial(example, "file.rst"), modes_of),
    "uff_2414": ("m.unv", partial(uff_analysis, 2), modes_of),
    "uff_2414_frf": ("m.unv", partial(uff_analysis, 5), io.read_frf_uff),
    "uff_58": ("m.uff", uff, io.read_frf_uff),
    "uff_58b": ("m.uff", partial(uff, 1), io.read_frf_uff),
    "uff_55": ("m.uff", uff_shapes, io.read_modes_uff),
    "uff_nodes": ("m.uff", uff_shapes, io.read_nodes_uff),
    "records_uff": ("m.uff", uff_records, io.read_records),
    "spectra_uff": ("m.uff", partial(uff_records, 9), io.read_spectra),
    "records_csv": ("t.csv", lambda: [logger(";", ","), logger(",", ".")], io.read_records),
    "records_lvm": ("t.lvm", lambda: [labview("One"), labview("Multi")], io.read_records),
    "dofs": ("d.csv", dofs_table, io.read_dofs),
    "frf_csv": ("f.csv", lambda: [saved(io.write_frf_csv, responses())], io.read_frf_csv),
    "frf_npz": ("f.npz", frf_npz, io.read_frf_npz),
    "frf_mat": ("f.mat", frf_mat, io.read_frf_mat),
    "mat_system": ("s.mat", system, io.read_mat),
    "load": ("v.npz", lambda: [saved(responses().save)], fx.load),
    "ansys_full": ("f.full", partial(example, "file.full"), io.read_ansys),
    "ansys_rst_nodes": ("f.rst", partial(example, "file.rst"), full_with_nodes),
    "ansys_cdb_nodes": ("f.cdb", partial(example, "HexBeam.cdb"), full_with_nodes),
    "any": ("f.txt", lambda: [*dmig(), *abaqus(), *bulk()], io.read_matrices),
}  # fmt: skip


def damaged(content, rng):
    """A copy with one to three damages."""
    if content[:2] == b"PK" and rng.random() < 0.8:  # inside of a zip file, with right checksums
        return repacked(content, rng)
    for _ in range(rng.integers(1, 4)):
        content = rng.choice(DAMAGES)(bytearray(content), rng)
    return bytes(content)


def repacked(content, rng):
    packed = BytesIO()
    with zipfile.ZipFile(BytesIO(content)) as old, zipfile.ZipFile(packed, "w") as new:
        names = old.namelist()
        chosen = names[rng.integers(len(names))]
        for name in names:
            body = old.read(name)
            new.writestr(
                name, bytes(rng.choice(DAMAGES)(bytearray(body), rng)) if name == chosen else body
            )
    return packed.getvalue()


def flip(content, rng):
    for at in rng.integers(0, max(len(content), 1), rng.integers(1, 6)):
        if content:
            content[at] = rng.integers(256)
    return content


def whole_number(content, rng):
    size = int(rng.choice([2, 4, 8]))
    if len(content) > size:
        # headers, in the first half thousand bytes, are hit as often as all the rest
        at = int(rng.integers(0, min(len(content), 500) if rng.random() < 0.5 else len(content)))
        value = int(rng.choice(WHOLE)) % 2 ** (8 * size)
        at -= at % 4 if rng.random() < 0.8 else 0
        content[at : at + size] = value.to_bytes(size, str(rng.choice(["little", "big"])))
    return content


def cut(content, rng):
    return content[: rng.integers(0, len(content) + 1)]


def cut_end(content, rng):
    return content[: max(0, len(content) - int(rng.integers(1, 12)))]


def removed(content, rng):
    at, count = int(rng.integers(0, len(content) + 1)), int(rng.integers(1, 40))
    del content[at : at + count]
    return content


def doubled(content, rng):
    at, count = int(rng.integers(0, len(content) + 1)), int(rng.integers(1, 80))
    content[at:at] = content[at : at + count]
    return content


def word(content, rng):
    found = list(re.finditer(rb"[^\s,();=]+", bytes(content[:20000])))
    if found:
        match = found[rng.integers(len(found))]
        new = WORDS[rng.integers(len(WORDS))]
        if rng.random() < 0.5:  # in a field of the same width
            new = new[-len(match[0]) :].rjust(len(match[0]))
        content[match.start() : match.end()] = new
    return content


def line(content, rng):
    lines = bytes(content).split(b"\n")
    i, j = rng.integers(len(lines), size=2)
    if rng.random() < 0.5:
        lines[i] = lines[j]
    else:
        del lines[i]
    return bytearray(b"\n".join(lines))


def end(content, rng):
    return bytearray(
        bytes(content).rstrip() + bytes(rng.choice([b" ", b"\n ", b"", b" \n", b"\0"]))
    )


DAMAGES = np.array(
    [flip, whole_number, cut, cut_end, removed, doubled, word, line, end], dtype=object
)


def forked(function, path, *, keep=""):
    """What `in_child` would return: the child starts in a millisecond, all is imported."""
    with tempfile.TemporaryFile() as answer:
        process = os.fork()
        if not process:
            with contextlib.suppress(BaseException):
                foreign_parsers.ALONE = True
                null = os.open(os.devnull, os.O_WRONLY)
                os.dup2(null, 1)
                os.dup2(null, 2)
                answer.write(foreign_parsers.outcome_of((sys.path, function, str(path))))
                answer.flush()
            os._exit(0)
        code = os.waitpid(process, 0)[1]
        answer.seek(0)
        return pickle.load(answer) if answer.seek(0, 2) and not answer.seek(0) else ("crash", code)


def used():
    """CPU seconds of this process and its children."""
    return sum(
        sum(resource.getrusage(who)[:2]) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)
    )


def tried(name, seconds, folder, seed, result):
    file, contents, read = READERS[name]
    seeds = contents()
    path = folder / name / file
    path.parent.mkdir(exist_ok=True)
    for content in seeds:
        path.write_bytes(gzip.compress(content) if file.endswith(".gz") else content)
        with contextlib.suppress(FlexplantError):
            read(path)
    # the valid files were read as they always are
    children = resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss // 1024
    foreign_parsers.run("ansys_mesh" if "ansys" in name else "matlab", "none")
    mat_variables.in_child = ansys.in_child = forked
    rng, strange = np.random.default_rng(seed), {}
    start, base = used(), resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    counts = {"files": 0, "read": 0}
    while used() - start < seconds:
        content = damaged(seeds[rng.integers(len(seeds))], rng)
        path.write_bytes(gzip.compress(content) if file.endswith(".gz") else content)
        counts["files"] += 1
        before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                read(path)
            counts["read"] += 1
        except FlexplantError:
            pass
        except Exception as error:
            frames = [
                f for f in traceback.extract_tb(error.__traceback__) if "flexplant" in f.filename
            ]
            place = f"{Path(frames[-1].filename).name} {frames[-1].lineno}"
            key = f"{type(error).__name__} {place}: {error!s:.60}"
            same = next((k for k in strange if k.split(":")[0] == key.split(":")[0]), key)
            strange[same] = strange.get(same, 0) + 1
            if strange[same] == 1:
                (folder / name / f"foreign{len(strange)}").write_bytes(content)
        if resource.getrusage(resource.RUSAGE_SELF).ru_maxrss > before + 30_000:
            (folder / name / "memory").write_bytes(content)
    grown = (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - base) // 1024
    result.write_text(
        json.dumps(counts | {"foreign": strange, "MB": grown, "MB of a child": children})
    )


def main():
    seconds, names = float(sys.argv[1]), sys.argv[2:] or list(READERS)
    # kept where a folder is named, with the files that failed
    kept = os.environ.get("FUZZ_FOLDER")
    scratch = contextlib.nullcontext(kept) if kept else tempfile.TemporaryDirectory()
    with scratch as folder:
        run_all(names, seconds, Path(folder))


def run_all(names, seconds, folder):
    for name in names:
        result = folder / f"{name}.json"
        result.unlink(missing_ok=True)
        process = os.fork()
        if not process:
            with contextlib.suppress(BaseException):
                tried(name, seconds, folder, int(os.environ.get("FUZZ_SEED", "1")), result)
            os._exit(0)
        status = os.waitpid(process, 0)[1]
        found = json.loads(result.read_text()) if result.exists() else {}
        print(json.dumps({"reader": name, "crash": status or not found} | found), flush=True)


if __name__ == "__main__":
    main()
