"""Register AFM scans onto the layouts from which they were printed."""

from litho_data.register.bend import Bend
from litho_data.register.geometry import apply_transform
from litho_data.register.quality import RegistrationQuality
from litho_data.register.resample import resample_to_layout
from litho_data.register.scan import Registration, centred_placement, register_scan
from litho_data.register.topography import predicted_topography, smooth_measured

__all__ = [
    "Bend",
    "Registration",
    "RegistrationQuality",
    "apply_transform",
    "centred_placement",
    "predicted_topography",
    "register_scan",
    "resample_to_layout",
    "smooth_measured",
]
