"""From the residual of a model on measured prints to named causes and a corrected model."""

from litho_models.loop.close import close_loop
from litho_models.loop.findings import LoopConfig, LoopFindings, corrected_chain
from litho_models.loop.result.record import CloseLoop
from litho_models.loop.run import close_loop_on_store, parse_priors

__all__ = [
    "CloseLoop",
    "LoopConfig",
    "LoopFindings",
    "close_loop",
    "close_loop_on_store",
    "corrected_chain",
    "parse_priors",
]
