"""Run the numerical tests on this processor, and again while it imitates older processors.

    python tests/processors.py [--all] [--after-native] [native] [avx2] [avx512]

Without names, the tests run as each of the three. With --all, every test runs, not only the quick numerical
ones. An older processor is skipped if this processor has no instructions that the older one lacks, and the
tests also run as "native". The option --after-native states that the native tests have just passed, so that
they count as run.
"""

from __future__ import annotations

import os
import subprocess
import sys
import time
from collections.abc import Collection
from pathlib import Path
from typing import NamedTuple

import torch

ROOT = Path(__file__).parents[1]
_QUICK = ["-m", "numerics and not slow and not long"]


class Processor(NamedTuple):
    """Describe a processor that this one can imitate.

    To imitate it, this processor needs the ``capability``. The variables in ``environment`` restrict the
    libraries to the instructions of the imitated processor. ``beyond`` lists capabilities that the imitated
    processor lacks. Any processor without these capabilities gives the same numbers as the imitated
    processor.
    """

    capability: str
    environment: dict[str, str]
    beyond: tuple[str, ...]


PROCESSORS = {
    "native": Processor("", {}, ()),
    "avx2": Processor(
        "avx2",
        {
            "ONEDNN_MAX_CPU_ISA": "AVX2",
            "ATEN_CPU_CAPABILITY": "avx2",
            "OPENBLAS_CORETYPE": "Haswell",
        },
        ("avx512_f", "avx_ne_convert"),
    ),
    # This processor has no bfloat16 unit, so oneDNN computes in float32 instead.
    "avx512": Processor(
        "avx512_f",
        {
            "ONEDNN_MAX_CPU_ISA": "AVX512_CORE",
            "ATEN_CPU_CAPABILITY": "avx512",
            "OPENBLAS_CORETYPE": "SkylakeX",
        },
        ("avx512_bf16", "amx_bf16"),
    ),
}


def can_play(name: str) -> bool:
    """Return whether this processor has all instructions of the named processor and can therefore imitate
    it.
    """
    capability = PROCESSORS[name].capability
    return not capability or bool(torch.cpu.get_capabilities().get(capability))


def why_left_out(name: str, beside: Collection[str]) -> str:
    """Return the reason why the tests are not run as the named processor, or "" if they are run."""
    if not can_play(name):
        return "this processor lacks the instructions"
    known = torch.cpu.get_capabilities()
    if name != "native" and "native" in beside and not any(known.get(one) for one in PROCESSORS[name].beyond):
        return "this processor gives the same numbers natively"
    return ""


def main(arguments: list[str]) -> int:
    """Run the tests as each of the named processors, and return 1 as the exit status if any run fails."""
    names = [argument for argument in arguments if not argument.startswith("--")]
    passed = ["native"] if "--after-native" in arguments else []
    chosen, what = ([], "all tests") if "--all" in arguments else (_QUICK, "numerics")
    known = [*PROCESSORS, "--all", "--after-native"]
    if unknown := set(arguments) - set(known):
        got, wanted = ", ".join(sorted(unknown)), ", ".join(known)
        print(f"processors: got {got}, wanted {wanted}", file=sys.stderr)
        return 2
    outcomes = []
    names = names or list(PROCESSORS)
    for name in names:
        if reason := why_left_out(name, [*names, *passed]):
            outcomes.append((name, f"skipped: {reason}"))
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
