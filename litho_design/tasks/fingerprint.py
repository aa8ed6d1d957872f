"""One hash for everything that decides a result."""

from __future__ import annotations

import hashlib
import json

from litho_data.foundation.results import Record


def record_sha256(*parts: Record | str) -> str:
    """Hex SHA-256 of records (as canonical JSON) and strings."""
    plain = [part if isinstance(part, str) else part.model_dump(mode="json") for part in parts]
    text = json.dumps(plain, sort_keys=True, ensure_ascii=False, allow_nan=False)
    return hashlib.sha256(text.encode()).hexdigest()
