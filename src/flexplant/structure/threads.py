"""One BLAS thread where many small blocks are worked on: more only wait for each other."""

from __future__ import annotations

from functools import cache
from typing import Any


@cache
def _controller() -> Any:
    from threadpoolctl import ThreadpoolController

    return ThreadpoolController()


def one_thread() -> Any:
    """Return a context in which BLAS runs on one thread."""
    return _controller().limit(limits=1, user_api="blas")
