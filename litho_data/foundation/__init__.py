"""Parts that all packages use: errors, files, hashes, units, records, run facts.

Here stand the names that most modules use; the others come from their modules.
"""

from litho_data.foundation.errors import InputError, about, damaged, require_known, unknown_name
from litho_data.foundation.files import atomic_file, parsed, table_beside
from litho_data.foundation.hashes import array_sha256, file_sha256, record_sha256
from litho_data.foundation.kinds import YX, Array, Facts, Shape
from litho_data.foundation.units import is_length, um_per

__all__ = [
    "YX",
    "Array",
    "Facts",
    "InputError",
    "Shape",
    "about",
    "array_sha256",
    "atomic_file",
    "damaged",
    "file_sha256",
    "is_length",
    "parsed",
    "record_sha256",
    "require_known",
    "table_beside",
    "um_per",
    "unknown_name",
]
