"""Parts that all packages use: errors, files, hashes, units, records, run facts.

Here stand the names that nearly every module uses; the others come from the modules.
"""

from litho_data.foundation.errors import InputError, about, damaged, require_known, unknown_name
from litho_data.foundation.kinds import YX, Array, Facts, Shape

__all__ = ["YX", "Array", "Facts", "InputError", "Shape", "about", "damaged", "require_known", "unknown_name"]
