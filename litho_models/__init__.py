"""Models of the printer. A model is trained on a dataset, corrected with terms that explain its residuals on
this dataset, and frozen (saved with fixed weights).
"""

from typing import TYPE_CHECKING

from litho_data.foundation.faces import lazy_face

if TYPE_CHECKING:
    from litho_models.effects import register_effect as register_effect
    from litho_models.evaluation.benchmark import benchmark as benchmark
    from litho_models.evaluation.evaluate import evaluate as evaluate
    from litho_models.evaluation.results import compare as compare
    from litho_models.fitting.patches import PatchDataset as PatchDataset
    from litho_models.fitting.runs import train as train
    from litho_models.frozen import zoo as zoo
    from litho_models.frozen.files import load_frozen as load_frozen
    from litho_models.frozen.files import save_frozen as save_frozen
    from litho_models.frozen.freezing import freeze as freeze
    from litho_models.frozen.simulator import FrozenSimulator as FrozenSimulator
    from litho_models.models import build_model as build_model
    from litho_models.models import register_simulator as register_simulator
    from litho_models.models.authors import model_of_authors as model_of_authors
    from litho_models.noise import analyse_noise as analyse_noise
    from litho_models.planning.rounds import close_loop as close_loop
    from litho_models.scan_terms import register_scan_term as register_scan_term
    from litho_models.scoring.metric_registry import register_metric as register_metric
    from litho_models.simulator import Simulator as Simulator

    __version__: str
else:
    __all__, __getattr__, __dir__ = lazy_face(__name__, __file__)
