"""Design diffractive optics through a frozen model of the printer, score the designs, and export them for
printing.
"""

from typing import TYPE_CHECKING

from litho_data.foundation.faces import lazy_face

if TYPE_CHECKING:
    from litho_design.elements.element import Element as Element
    from litho_design.exports.files import export as export
    from litho_design.exports.files import import_levels as import_levels
    from litho_design.holograms.settings import hologram_settings as hologram_settings
    from litho_design.images.measurements import MeasuredSource as MeasuredSource
    from litho_design.images.measurements import PhotoSource as PhotoSource
    from litho_design.judging.loaded import load_design as load_design
    from litho_design.lenses.settings import lens_settings as lens_settings
    from litho_design.optimisation.settings import design_settings as design_settings
    from litho_design.printers.source import load_printer as load_printer
    from litho_design.tasks.task import Task as Task
    from litho_design.tasks.task import register_task as register_task
    from litho_design.workflows.compare import compare as compare
    from litho_design.workflows.design import correct as correct
    from litho_design.workflows.design import design as design
    from litho_design.workflows.design import design_hologram as design_hologram
    from litho_design.workflows.design import design_lens as design_lens
    from litho_design.workflows.first import first as first
    from litho_design.workflows.score import score as score

    __version__: str
else:
    __all__, __getattr__, __dir__ = lazy_face(__name__, __file__)
