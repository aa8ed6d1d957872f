"""What every page owes the benchmarks that it quotes."""

from __future__ import annotations

import json
from types import ModuleType

from benchmarks.record import NOT_MEASURED, published


def require_quoted(benchmark: ModuleType) -> None:
    """The page of a benchmark has the text of its committed result, or says that there is none."""
    text = published(benchmark.PAGE, benchmark.NAME)
    if not benchmark.RESULT.exists():
        assert text == NOT_MEASURED
        return
    assert text == benchmark.as_markdown(json.loads(benchmark.RESULT.read_text(encoding="utf-8")))
