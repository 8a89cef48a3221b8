"""``python -m flexplant.workbench measured.uff``: the page on a file."""

from __future__ import annotations

import argparse
import re
import sys
from typing import Any

from ..errors import FlexplantError
from ..lti.frequency import ORDERS, Frf
from .launch import open_file, open_page


def main(words: list[str] | None = None) -> int:
    """Read the files, serve the page until Ctrl-C."""
    parser = argparse.ArgumentParser(
        prog="python -m flexplant.workbench", description="Shape loops by hand in a browser."
    )
    parser.add_argument(
        "files", nargs="+", metavar="FILE",
        help="measured responses or plants (several: a fleet), and a saved design to go on with",
    )  # fmt: skip
    parser.add_argument(
        "--quantity", choices=tuple(ORDERS), help="what measured outputs shall be, converted"
    )
    parser.add_argument("--scale", type=float, help="what brings a measurement to SI")
    parser.add_argument("--model", help="a saved StandardPlant in addition to a measurement")
    parser.add_argument("--rate", type=float, help="of the controller [Hz]; of a measurement")
    parser.add_argument("--continuous", action="store_true", help="no rate, so no C: to look only")
    parser.add_argument("--delay", type=float, help="samples in addition to what was measured")
    parser.add_argument("--sampled", action="store_true", help="measured from sample to sample")
    parser.add_argument("--rigid", type=int, help="rigid-body modes of the measured plant")
    parser.add_argument(
        "--port", type=int, default=0, help="of the server; any free one if not given"
    )
    parser.add_argument("--no-browser", action="store_true", help="serve, but open no browser")
    given = parser.parse_args(words)
    try:
        options = {"quantity": given.quantity, "scale": given.scale}
        found = [open_file(path, **options) for path in given.files]
        read = zip(given.files, found, strict=True)
        plants: dict[str, Any] = {path: one[0] for path, one in read if one[0] is not None}
        designs = [design for _, design, _ in found if design is not None]
        if not plants:
            sys.stderr.write("a design has no plant in it: name the file of its plant too.\n")
            return 2
        measured = isinstance(next(iter(plants.values())), Frf)
        if measured and not (given.rate or given.model or designs or given.continuous):
            sys.stderr.write(
                "a measurement does not say at what rate its controller runs: give --rate, such as "
                "--rate 10000 (with --sampled if it was measured from sample to sample), or "
                "--continuous to look only.\n"
            )
            return 2
        bench = open_page(
            plants, design=designs[-1] if designs else None,
            model=open_file(given.model)[0] if given.model else None, rate=given.rate,
            delay=given.delay, hold=False if given.sampled else None, rigid=given.rigid,
            source=next(line for plant, _, line in found if plant is not None), open_browser=False,
        )  # fmt: skip
        bench.serve(given.port)
    except (FlexplantError, OSError) as problem:
        sys.stderr.write(f"{_as_typed(str(problem))}\n")
        return 1
    try:
        sys.stdout.write(f"flexplant workbench at {bench.url}, Ctrl-C ends it\n")
        sys.stdout.flush()
        if not given.no_browser:
            import webbrowser

            webbrowser.open(bench.url)
        bench.wait()
    except KeyboardInterrupt:  # before it waits
        bench.close()
    return 0


def _as_typed(text: str) -> str:
    """Return advice with the options as they are typed here: --quantity acceleration."""
    names = "quantity|scale|rate|delay|rigid|model|port"
    return re.sub(rf"\b({names})=('?)(\.\.\.|[^\s',;]*[^\s',;.])\2", r"--\1 \3", text)


if __name__ == "__main__":
    sys.exit(main())
