"""Simulate a printer and an AFM from the physics of printing and scanning. The simulation shares no code with
the models that are tested on it.
"""

from litho_data.virtual_fab.fab import Fab, FabScan, scan_job
from litho_data.virtual_fab.jobs import jobs_of_card
from litho_data.virtual_fab.knobs import KNOBS, Knob, KnobSetting
from litho_data.virtual_fab.printer import Cause, Job
from litho_data.virtual_fab.settings import Microscope, Noise, Printer
from litho_data.virtual_fab.simulate import simulate, simulate_plan
from litho_data.virtual_fab.strength import KnobStrength, knob_rms_nm, strength_for_rms
from litho_data.virtual_fab.truth import Truth

__all__ = [
    "KNOBS",
    "Cause",
    "Fab",
    "FabScan",
    "Job",
    "Knob",
    "KnobSetting",
    "KnobStrength",
    "Microscope",
    "Noise",
    "Printer",
    "Truth",
    "jobs_of_card",
    "knob_rms_nm",
    "scan_job",
    "simulate",
    "simulate_plan",
    "strength_for_rms",
]
