"""The terms that a scan adds to the height of the print, such as datum and tilt. These terms are fitted to
pixels that are not scored, and are then subtracted from the pixels that are scored.
"""

from litho_models.scan_terms.blocks import Blocks
from litho_models.scan_terms.cross_fit import CrossFit, cross_fit, fitted_terms, freed_um, least_squares
from litho_models.scan_terms.lines import scan_line_index, shrunk_line_offsets
from litho_models.scan_terms.policies import (
    POLICIES,
    BackgroundUse,
    NuisanceProtocol,
    Policy,
    policy_terms,
)
from litho_models.scan_terms.term import (
    SCAN_TERMS,
    FloatMap,
    LineIndex,
    ScanTerm,
    TermPixels,
    Terms,
    chosen_terms,
    line_terms,
    parameter_names,
    register_scan_term,
    row_index,
    term_maps,
    terms_of_effect,
)

__all__ = [
    "POLICIES",
    "SCAN_TERMS",
    "BackgroundUse",
    "Blocks",
    "CrossFit",
    "FloatMap",
    "LineIndex",
    "NuisanceProtocol",
    "Policy",
    "ScanTerm",
    "TermPixels",
    "Terms",
    "chosen_terms",
    "cross_fit",
    "fitted_terms",
    "freed_um",
    "least_squares",
    "line_terms",
    "parameter_names",
    "policy_terms",
    "register_scan_term",
    "row_index",
    "scan_line_index",
    "shrunk_line_offsets",
    "term_maps",
    "terms_of_effect",
]
