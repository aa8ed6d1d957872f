"""Files for the printer, each with its sidecar, and the way back."""

from litho_design.export.files import export_design, import_levels
from litho_design.export.sidecar import Sidecar, read_sidecar, sidecar_path

__all__ = ["Sidecar", "export_design", "import_levels", "read_sidecar", "sidecar_path"]
