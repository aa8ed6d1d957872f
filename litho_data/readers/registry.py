"""List the formats that can be read, and detect a file's format from its content, never from its suffix."""

from pathlib import Path

from litho_data.foundation import InputError, unknown_name
from litho_data.foundation.plugins import foreign_sha256
from litho_data.readers import arrays, gsf, gwy, hdf5, npy, surfer, text_matrix, tiff, vendor, wyko
from litho_data.readers.reader import Reader, unknown_content

# Readers are listed in the order in which they are tried. Formats with their own signature come first. After
# them come containers and text files, which many programs write.
_READERS = [
    gsf.READER,
    gwy.READER,
    npy.READER,
    npy.ARCHIVE_READER,
    surfer.READER,
    wyko.READER,
    arrays.NETCDF_READER,
    arrays.MATLAB_READER,
    hdf5.READER,
    vendor.READER,
    tiff.READER,
    text_matrix.READER,
]
# Maps the name of each registered reader to the hash of its source code.
_REGISTERED: dict[str, str] = {}
PICTURE = "image"
_PICTURE_MAGIC = (b"\x89PNG\r\n\x1a\n", b"BM")
_HEAD_BYTES = 1 << 16


def formats() -> tuple[str, ...]:
    """Return the names of all formats, in the order in which they are tried on a file."""
    return tuple(reader.name for reader in _READERS)


def register_reader(reader: Reader) -> Reader:
    """Register a reader for another format. The new reader is tried before the existing readers.

    The build of a dataset may start several processes, and each of them must register the reader. Therefore,
    call this function in a plug-in, or at the top level of the script that starts the build.

    Raises:
        InputError: a format of that name already exists.
    """
    if reader.name in ("auto", PICTURE, *formats()):
        raise InputError("reader to register", got=f"{reader.name!r}, which exists", wanted="another name")
    _READERS.insert(0, reader)
    _REGISTERED[reader.name] = foreign_sha256(reader.read_channels)
    return reader


def registered() -> dict[str, str]:
    """Return a dict that maps the name of each registered reader to the hash of its source code."""
    return dict(_REGISTERED)


def reader_of(format: str) -> Reader:
    """Return the reader of the format with the given name.

    Raises:
        InputError: there is no reader of that name.
    """
    for reader in _READERS:
        if reader.name == format:
            return reader
    raise unknown_name("scan format", format, ("auto", *formats()))


def detect_format(path: Path) -> str:
    """Return the name of the first format whose reader recognises the file, or ``"image"`` for PNG and BMP.

    Raises:
        InputError: no format recognises the file.
    """
    with path.open("rb") as stream:
        head = stream.read(_HEAD_BYTES)
    if head.startswith(_PICTURE_MAGIC):
        return PICTURE
    for reader in _READERS:
        if reader.recognises(path, head):
            return reader.name
    raise unknown_content(head)


def require_file(path: str | Path) -> Path:
    """Return the path if it is a file that is not empty.

    Raises:
        InputError: the path does not exist or is a folder, or the file is empty or not readable.
    """
    file = Path(path)
    try:
        if not file.exists():
            raise InputError(f"no such file: {file}")
        if not file.is_file():
            raise InputError(f"{file} is not a file")
        with file.open("rb") as stream:
            if not stream.read(1):
                raise InputError(f"{file} is empty")
    except OSError as error:
        raise InputError(f"cannot open {file}", got=error) from error
    return file
