"""Run and record a single step of a build. The record states how the step made its arrays, so that they can
be reproduced.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

from litho_data.foundation import Array, Facts, InputError, array_sha256, file_sha256, record_sha256
from litho_data.foundation.hashes import source_sha256
from litho_data.store.schema import VARIABLES

if TYPE_CHECKING:
    from threadpoolctl import ThreadpoolController

PACKAGE = Path(__file__).parents[1]
Arrays = dict[str, Array]
# An operation maps (parameters, raw files, input arrays by name) to arrays and facts.
Params = Facts
Files = Sequence[Path]
Inputs = Mapping[str, Array]
Made = tuple[Arrays, Facts]
Function = Callable[[Params, Files, Inputs], Made]


@dataclass(frozen=True)
class Step:
    """The record of one operation on one scan, with its parameters, inputs and outputs.

    Each input is a mapping with the keys ``name`` and ``sha256``. The name of a file is its path below the
    data folder. Each output has the keys ``name``, ``sha256``, ``dtype``, ``shape``, ``unit`` and ``dims``.
    ``code_sha256`` identifies the source code that ran. This hash is not part of the step's id, because some
    changes of the code, such as moving a comment, do not change a result.
    """

    op: str
    op_version: str
    params: Facts
    inputs: tuple[Mapping[str, str], ...]
    outputs: tuple[Facts, ...]
    code_sha256: str

    @property
    def id(self) -> str:
        """Return the hash of the operation's name and version, its parameters and its inputs. Steps with
        equal ids must have equal outputs.
        """
        inputs = [[one["name"], one["sha256"]] for one in self.inputs]
        return record_sha256([self.op, self.op_version, self.params, inputs])

    def to_record(self) -> dict[str, Any]:
        """Return the step and its id as plain data, for storing."""
        return {"id": self.id, **asdict(self)}

    @classmethod
    def from_record(cls, record: Facts) -> Step:
        """Make the step from its stored record. The id in the record is ignored. A caller can therefore
        compare the stored id with the id that is computed from the step.
        """
        fields = {key: value for key, value in record.items() if key != "id"}
        return cls(**{**fields, "inputs": tuple(fields["inputs"]), "outputs": tuple(fields["outputs"])})


@dataclass(frozen=True)
class Operation:
    """A processing operation, which is a pure function of recorded parameters and inputs.

    Args:
        name: name of the operation in the records.
        version: version of the operation. If a change of the function may change its results, the version is
            changed too.
        function: function ``function(params, files, arrays)`` that returns a mapping from names to arrays,
            and a mapping of facts.
        takes: names of the input arrays, in the order in which they are recorded. Arrays that a scan does not
            have are left out.
        code: files and folders of this package on which the result depends.
    """

    name: str
    version: str
    function: Function
    takes: tuple[str, ...]
    code: tuple[str, ...]

    @property
    def code_sha256(self) -> str:
        """Return the hash of the source code on which the result depends."""
        return _code_sha256(self.code)

    def run(
        self, params: Facts, files: Mapping[str, Path], arrays: Mapping[str, Array]
    ) -> tuple[Step, Arrays, Facts]:
        """Run the operation. Return the record of the step, the arrays it made, and the facts it found.

        Args:
            params: all parameters of the operation, as plain data.
            files: paths of raw files, keyed by their recorded names, in the order that the operation expects.
            arrays: arrays, keyed by their names in the store. Only the arrays named in ``takes`` are used.

        Raises:
            InputError: something is wrong with the input, for example a file is missing or unreadable.
        """
        arrays = {name: arrays[name] for name in self.takes if name in arrays}
        try:
            inputs = [{"name": name, "sha256": file_sha256(path)} for name, path in files.items()]
            inputs += [
                {"name": name, "sha256": VARIABLES[name].sample_sha256(array)}
                for name, array in arrays.items()
            ]
            with _one_thread():
                made, facts = self.function(params, list(files.values()), arrays)
        except OSError as error:
            raise InputError(f"cannot read {', '.join(map(str, files.values()))}", got=str(error)) from error
        outputs = tuple(_described(name, array) for name, array in made.items())
        step = Step(self.name, self.version, dict(params), tuple(inputs), outputs, self.code_sha256)
        return step, made, facts


@cache
def _code_sha256(names: tuple[str, ...]) -> str:
    return source_sha256(*(PACKAGE / name for name in names))


@contextmanager
def _one_thread() -> Iterator[None]:
    """Limit the numerical libraries to one thread inside a ``with`` block. The results then do not depend on
    the number of cores, and parallel workers do not compete for cores.
    """
    import cv2

    threads = cv2.getNumThreads()
    cv2.setNumThreads(1)
    try:
        with _libraries().limit(limits=1):
            yield
    finally:
        cv2.setNumThreads(threads)


@cache
def _libraries() -> ThreadpoolController:
    """Return an object that limits the threads of the numerical libraries. It is cached, because finding the
    libraries takes 10 ms.
    """
    import scipy.linalg  # noqa: F401 - SciPy has its own BLAS, which can be limited only once it is loaded
    from threadpoolctl import ThreadpoolController

    return ThreadpoolController()


def _described(name: str, array: Array) -> dict[str, Any]:
    variable = VARIABLES[name]
    dims, unit = variable.sample_dims, variable.unit
    sha256 = array_sha256(array, unit, dims)
    return {
        "name": name,
        "sha256": sha256,
        "dtype": str(array.dtype),
        "shape": list(array.shape),
        "unit": unit,
        "dims": list(dims),
    }
