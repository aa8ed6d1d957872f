"""Basic parts that all packages of the project use: errors, files, hashes, units, records, and facts about a
run.

This package exports the names that most modules use. Import all other names from their modules.
"""

from typing import TYPE_CHECKING

from litho_data.foundation.faces import lazy_face

if TYPE_CHECKING:
    from litho_data.foundation.errors import InputError as InputError
    from litho_data.foundation.errors import about as about
    from litho_data.foundation.errors import damaged as damaged
    from litho_data.foundation.errors import require_known as require_known
    from litho_data.foundation.errors import unknown_name as unknown_name
    from litho_data.foundation.files import atomic_file as atomic_file
    from litho_data.foundation.files import parsed as parsed
    from litho_data.foundation.files import table_beside as table_beside
    from litho_data.foundation.hashes import array_sha256 as array_sha256
    from litho_data.foundation.hashes import file_sha256 as file_sha256
    from litho_data.foundation.hashes import record_sha256 as record_sha256
    from litho_data.foundation.kinds import YX as YX
    from litho_data.foundation.kinds import Array as Array
    from litho_data.foundation.kinds import Facts as Facts
    from litho_data.foundation.kinds import Shape as Shape
    from litho_data.foundation.units import NM_PER_UM as NM_PER_UM
    from litho_data.foundation.units import is_length as is_length
    from litho_data.foundation.units import um_per as um_per
else:
    __all__, __getattr__, __dir__ = lazy_face(__name__, __file__)
