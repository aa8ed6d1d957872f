"""The tests of numerics on this processor, and once more as if it were an older one.

    python tests/processors.py [--all] [native] [avx2] [avx512]

Without names as all of them; with --all every test, not only those of numerics that are quick.
"""

from __future__ import annotations

import os
import subprocess
import sys
import time
from pathlib import Path
from typing import NamedTuple

import torch

ROOT = Path(__file__).parents[1]
_QUICK = ["-m", "numerics and not slow and not long"]


class Processor(NamedTuple):
    """What a processor must be able to do to play another, and what makes the libraries play it."""

    capability: str
    environment: dict[str, str]


PROCESSORS = {
    "native": Processor("", {}),
    "avx2": Processor(
        "avx2",
        {
            "ONEDNN_MAX_CPU_ISA": "AVX2",
            "ATEN_CPU_CAPABILITY": "avx2",
            "OPENBLAS_CORETYPE": "Haswell",
            "NUMBA_CPU_NAME": "haswell",
            # Else Numba takes the features of this processor under the name of the other.
            "NUMBA_CPU_FEATURES": "",
        },
    ),
    # Without the bfloat16 unit, which oneDNN then replaces by arithmetic in float32.
    "avx512": Processor(
        "avx512_f",
        {
            "ONEDNN_MAX_CPU_ISA": "AVX512_CORE",
            "ATEN_CPU_CAPABILITY": "avx512",
            "OPENBLAS_CORETYPE": "SkylakeX",
            "NUMBA_CPU_NAME": "skylake-avx512",
            "NUMBA_CPU_FEATURES": "",
        },
    ),
}


def can_play(name: str) -> bool:
    """Whether this processor knows the instructions of the other."""
    capability = PROCESSORS[name].capability
    return not capability or bool(torch.cpu.get_capabilities().get(capability))


def main(arguments: list[str]) -> int:
    """Run the tests as each of the named processors; the exit status is 1 where one of them fails."""
    names = [argument for argument in arguments if argument != "--all"]
    chosen, what = ([], "all tests") if "--all" in arguments else (_QUICK, "numerics")
    unknown = set(names) - set(PROCESSORS)
    if unknown:
        got, wanted = ", ".join(sorted(unknown)), ", ".join(PROCESSORS)
        print(f"processors: got {got}, wanted {wanted}", file=sys.stderr)
        return 2
    outcomes = []
    for name in names or PROCESSORS:
        if not can_play(name):
            outcomes.append((name, "left out: this processor has other instructions"))
            continue
        print(f"== {what}, {name}", flush=True)
        started = time.perf_counter()
        pytest = [sys.executable, "-m", "pytest", "-n", "2", *chosen]
        done = subprocess.run(pytest, cwd=ROOT, env={**os.environ, **PROCESSORS[name].environment})
        verdict = "failed" if done.returncode else "passed"
        outcomes.append((name, f"{verdict} in {time.perf_counter() - started:.0f} s"))
    for name, outcome in outcomes:
        print(f"{name:8} {outcome}")
    return int(any(outcome.startswith("failed") for _, outcome in outcomes))


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
