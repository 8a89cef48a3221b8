"""report: a design as one self-contained page, to be mailed."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from ..checks import short
from ..simulation import Response
from ..store import written
from ..versions import versions
from .html.page import Chapter, Gallery, page, table
from .html.result import Design, loops_section, result
from .html.sections import certificates, sections


def report(
    path: str | Path,
    *parts: Any,
    title: str = "Design report",
    subtitle: str = "",
    channel: str | None = None,
    seeds: Mapping[str, Any] | None = None,
) -> Path:
    """Write a design to one self-contained HTML file: result, design, certificates, versions.

    The file loads nothing from elsewhere. Its pictures can be zoomed, dragged and read with the
    cursor, mode shapes move, and it prints. The same values give the same file, to the byte.

    Parameters
    ----------
    path : str or Path
        The file, replaced when it is there.
    *parts : values of this package, or mappings {name: value}
        What to report, in any order: plants, observers, controllers, loops, runs, placements,
        modes, updates, studies. Of several loops the figures at the top are those of the first.
        A value of another kind shows its repr.
    title, subtitle : str
        What stands at the top. No date is added, which would make equal designs differ.
    channel : str, optional
        The z whose error comes first; the first error at a POI when not given.
    seeds : mapping {str: seed}, optional
        What chance was drawn from, for the record, beside the seeds that runs keep.

    Returns
    -------
    Path
        The file.

    Raises
    ------
    ModelError
        When there is nothing to report, or a part is no value of this package.

    Examples
    --------
    >>> import flexplant as fx, tempfile
    >>> folder = tempfile.mkdtemp()
    >>> file = fx.plot.report(f"{folder}/filter.html", {"filter": fx.lowpass(10.0)})
    >>> "filter" in file.read_text(encoding="utf-8")
    True
    """
    design, gallery = Design(parts), Gallery()
    runs = design.of(Response).items()
    noisy = {name: run.seed for name, run in runs if run.seed is not None}
    found = [
        result(design, gallery, channel),
        loops_section(design, gallery),
        *sections(design, gallery),
        certificates(design),
        _origin({**noisy, **(seeds or {})}),
    ]
    text = page(str(title), str(subtitle), [one for one in found if one is not None])
    with written(path) as file:
        file.write(text.encode("utf-8"))
    return Path(path)


def _origin(seeds: Mapping[str, Any]) -> Chapter:
    """Return the section of versions and seeds."""
    rows = [[f"seed of {name}", short(seed)] for name, seed in seeds.items()]
    rows += [list(pair) for pair in versions().items()]
    return Chapter("Seeds and versions", table(["", ""], rows, words=True))
