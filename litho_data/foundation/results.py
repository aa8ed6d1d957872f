"""Result files: JSON with a schema version, validated on writing and on reading."""

import json
import reprlib
from functools import partial
from pathlib import Path
from typing import Any, ClassVar, Self

from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from litho_data.foundation.errors import InputError
from litho_data.foundation.files import atomic_file, parsed

# Messages show unexpected values in short form, because they may have any size and be nested to any depth.
_SHORT = reprlib.Repr()
_LONGEST = 40
_SHORT.maxstring = _SHORT.maxother = 120


class Record(BaseModel):
    """Base class of immutable records. Result files consist of such records. Unknown keys are errors. The
    keys listed in ``FORMER`` occur only in older files and are ignored. Such keys are kept for stores, frozen
    models and designs, which stay readable. Results of analyses are computed again.
    """

    FORMER: ClassVar[frozenset[str]] = frozenset()
    model_config = ConfigDict(frozen=True, extra="forbid", populate_by_name=True)

    @model_validator(mode="before")
    @classmethod
    def _of_today(cls, content: Any) -> Any:
        if not isinstance(content, dict):
            return content
        return {name: value for name, value in content.items() if name not in cls.FORMER}


class Result(Record):
    """Base class of records that are written as result files. Subclasses set ``FILE_NAME`` and ``SCHEMA``.
    ``SCHEMA`` contains the name and the version of the file's schema.
    """

    SCHEMA: ClassVar[str]
    FILE_NAME: ClassVar[str]

    schema_: str = Field(default="", alias="schema")

    @model_validator(mode="before")
    @classmethod
    def _of_this_schema(cls, content: Any) -> Any:
        content = {"schema": cls.SCHEMA} | content if isinstance(content, dict) else content
        if isinstance(content, dict) and content["schema"] != cls.SCHEMA:
            raise ValueError(f"schema {content['schema']!r} is not {cls.SCHEMA!r}")
        return content

    def __repr__(self) -> str:
        return f"<{type(self).__name__} {', '.join(f'{name}: {value}' for name, value in self._facts())}>"

    __str__ = __repr__

    def _repr_html_(self) -> str:
        import pandas as pd

        return pd.DataFrame(self._facts()).to_html(index=False, header=False)

    def _facts(self) -> list[tuple[str, str]]:
        """Return pairs (name of a field, text) for a one-line summary. The text is a short value, the name of
        a nested record, or the size of a collection.
        """
        facts = []
        for name in type(self).model_fields:
            value = getattr(self, name)
            # A nested record that has a name (such as a dataset or a model) is represented by its name.
            value = getattr(value, "name", value)
            if isinstance(value, list | tuple | dict):
                value = len(value)
            if name != "schema_" and isinstance(value, str | int | float) and 0 < len(str(value)) <= _LONGEST:
                facts.append((name, str(value)))
        return facts

    def write(self, folder: str | Path) -> Path:
        """Write ``folder/FILE_NAME`` atomically and return its path."""
        path = Path(folder) / self.FILE_NAME
        # The record is validated once more from plain JSON, so that a reader will accept what is written.
        content = self.model_dump(mode="json", by_alias=True)
        text = json.dumps(content, indent=1, ensure_ascii=False, allow_nan=False)
        type(self).model_validate_json(text)
        with atomic_file(path) as temporary:
            temporary.write_text(text + "\n", encoding="utf-8")
        return path

    @classmethod
    def read(cls, path: str | Path) -> Self:
        """Read one result from its file, or from the folder that contains this file.

        Raises:
            InputError: the file does not exist, is not JSON, or has another schema or unexpected fields.
        """
        file = Path(path)
        file = file / cls.FILE_NAME if file.is_dir() else file
        kind = "/".join(cls.SCHEMA.split("/")[:2])
        parse = partial(json.loads, parse_constant=_refuse)
        content = parsed(file, parse, f"cannot read {file}", f"a result file of kind {kind}")
        schema = content.get("schema") if isinstance(content, dict) else None
        if schema != cls.SCHEMA:
            raise InputError(f"schema of {file}", got=repr(schema), wanted=repr(cls.SCHEMA))
        try:
            return cls.model_validate(content)
        except ValidationError as error:
            raise InputError(f"fields of {file}", got=first_error(error), wanted=cls.SCHEMA) from error


def first_error(error: ValidationError) -> str:
    """Return pydantic's first error as one line that states the key, the problem and the value."""
    first = error.errors()[0]
    where = ".".join(str(part) for part in first["loc"][:8]) or "(root)"
    if first["type"] == "extra_forbidden":
        return f"unknown key {where}"
    return f"{where}: {first['msg']} (value {_SHORT.repr(first['input'])})"


def _refuse(constant: str) -> None:
    raise ValueError(f"{constant} is not a number in JSON")
