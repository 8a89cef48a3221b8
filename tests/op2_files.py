"""Small .op2 and .pch files of modes, written word by word."""

import numpy as np


def op2(
    xyz,
    moves,
    values,
    eigenvalues,
    masses,
    *,
    order="<",
    size=4,
    name="OUGV1",
    lama=True,
    systems=True,
    geometry=True,
    subcases=1,
    double=False,
    cards=None,
    into=None,
    keys=None,
    table_code=(2, 7, 8),
):
    """Nodes {id: place}, {id: system} that they move in, values (k, nodes, 6), modal data (k,).

    `cards` are coordinate systems (card, number, base, nine numbers) in the place of system 5, and
    `into` is {id: system} in which places are given. `double` writes geometry in double precision,
    and `keys` changes the third word of a card's key. `table_code` is (approach, table, words).
    """

    def words(*items):
        parts = [
            np.array(item, f"{order}{'f' if isinstance(item, float) else 'i'}{size}")
            for item in items
        ]
        return b"".join(part.tobytes() for part in parts)

    def record(body):
        length = np.array(len(body), f"{order}i4").tobytes()
        return length + body + length

    def key(number):
        return record(words(number))

    def data(body):
        return key(len(body) // size) + record(body)

    def letters(text):
        four = [text[i : i + 4].ljust(size).encode() for i in (0, 4)]
        return b"".join(four)

    def table(title, *records):
        title = title.ljust(8)
        parts = [data(letters(title)), key(-1), data(words(*range(7))), key(-2)]
        parts += [data(words(0)), data(letters(title)), key(-3)]
        for number, body in enumerate(records, 4):
            parts += [data(words(0)), data(body), key(-number)]
        return b"".join(parts) + data(words(0)) + key(0)

    real = np.dtype(f"{order}f{8 if double else size}")

    def reals(values):
        return np.asarray(values, real).tobytes()

    def card(name):
        number, short, plain, wide = {
            "GRID": (4501, 45, 1, 1120001),
            "CORD2R": (2101, 21, 8, 2220008),
            "CORD2C": (2001, 20, 9, 2220009),
            "CORD2S": (2201, 22, 10, 2220010),
        }[name]
        return words(number, short, (keys or {}).get(name, wide if double else plain))

    content = data(words(1, 2, 26)) + data(b"NASTRAN FORT TAPE ID CODE - ".ljust(7 * size))
    content += data(letters("TEST")) + key(-1) + key(0)
    if geometry:
        grids = [
            words(i, (into or {}).get(i, 0)) + reals(place) + words(moves.get(i, 0), 0, 0)
            for i, place in xyz.items()
        ]
        if cards is None:
            upright = (0.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0, 1.0, 0.0)
            cards = [("CORD2R", 5, 0, upright)] if systems else []
        kinds = {"CORD2R": 1, "CORD2C": 2, "CORD2S": 3}
        written = [
            card(name) + words(number, kinds[name], 2, base) + reals(points)
            for name, number, base, points in cards
        ]
        nodes = card("GRID") + b"".join(grids)
        content += table("GEOM1", *written, nodes, words(65535, 0, 0))
    if lama:
        rows = [
            words(i, i, float(v), float(abs(v) ** 0.5), 0.0, float(m), float(v * m))
            for i, (v, m) in enumerate(zip(eigenvalues, masses, strict=True), 1)
        ]
        content += table("LAMA", words(*[0] * 146), b"".join(rows))
    records = []
    for subcase in range(1, subcases + 1):
        for mode, (value, shape) in enumerate(zip(eigenvalues, values, strict=True), 1):
            approach, code, width = table_code
            ident = (10 * approach + 1, code, 0, subcase, mode, float(value), 0.0, 0, 1, width)
            records.append(words(*ident, *[0] * 136))
            rows = [words(10 * i + 1, 1, *map(float, v)) for i, v in zip(xyz, shape, strict=True)]
            records.append(b"".join(rows))
    return content + table(name, *records) + key(0)


def punch(values, eigenvalues, ids):
    """Eigenvectors as DISPLACEMENT(PUNCH) writes them."""
    lines = []

    def put(text):
        lines.append(f"{text:72}{len(lines) + 1:8}\n")

    for mode, (value, shape) in enumerate(zip(eigenvalues, values, strict=True), 1):
        for head in (
            "$TITLE   = BEAM",
            "$EIGENVECTOR",
            "$REAL OUTPUT",
            "$SUBCASE ID =           1",
        ):
            put(head)
        put(f"$EIGENVALUE ={value:15.7E}  MODE ={mode:6}")
        for node, row in zip(ids, shape, strict=True):
            put(f"{node:10}       G" + "".join(f"{number:18.6E}" for number in row[:3]))
            put("-CONT-            " + "".join(f"{number:18.6E}" for number in row[3:]))
    return "".join(lines)
