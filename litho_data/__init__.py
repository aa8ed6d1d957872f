"""Turn raw AFM files and layouts into a dataset that records the origin of every array.

To process one scan, call ``read_scan``, ``level_scan``, ``register_scan`` and ``resample_to_layout`` in this
order. To build a whole dataset, call ``build_dataset`` with a dataset card (the TOML file that describes the
raw files), and read the result with ``open_store``. ``fetch`` downloads the files of a known dataset.
``simulate`` writes the raw files that a virtual printer and a virtual microscope would deliver.
"""

from typing import TYPE_CHECKING

from litho_data.foundation.faces import lazy_face

if TYPE_CHECKING:
    from litho_data.cards.fetch import fetch as fetch
    from litho_data.foundation.errors import InputError as InputError
    from litho_data.foundation.plugins import load_plugins as load_plugins
    from litho_data.level.recipe import Recipe as Recipe
    from litho_data.level.scan import level_scan as level_scan
    from litho_data.making.build import build_dataset as build_dataset
    from litho_data.provenance.verify import verify as verify
    from litho_data.readers.layout import read_layout as read_layout
    from litho_data.readers.read import read_scan as read_scan
    from litho_data.register.resample import resample_to_layout as resample_to_layout
    from litho_data.register.scan import register_scan as register_scan
    from litho_data.scan import Scan as Scan
    from litho_data.store.read import PrintedScan as PrintedScan
    from litho_data.store.read import Store as Store
    from litho_data.store.read import open_store as open_store
    from litho_data.virtual_fab.simulate import simulate as simulate

    __version__: str
else:
    __all__, __getattr__, __dir__ = lazy_face(__name__, __file__)
