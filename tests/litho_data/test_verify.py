"""Check that ``verify`` names any changed byte, that ``replay`` reproduces all arrays, and that ``history``
leads to the raw files.
"""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import zarr

from litho_data.foundation.errors import InputError
from litho_data.provenance.history import history, replay
from litho_data.provenance.verify import verify
from litho_data.store.access import array_of, values_of


def flip(path: Path, position: float = 0.5) -> None:
    """Flip one bit of a file, at this fraction of its length."""
    content = bytearray(path.read_bytes())
    content[int(position * len(content))] ^= 1
    path.write_bytes(content)


def named(folder: Path) -> str:
    return "\n".join(str(finding) for finding in verify(folder / "prints.zarr").findings)


def test_an_untouched_store_has_no_findings(campaign: Path) -> None:
    result = verify(campaign / "prints.zarr")
    assert result.findings == ()
    assert result.notes == ()
    # Each scan has the eight arrays layout, raw, levelled, removed, transform, height, valid and sigma, six
    # steps, and two files.
    assert (result.n_arrays, result.n_steps, result.n_raw_files) == (24, 18, 6)


@pytest.mark.parametrize("name", ["scans/P12.txt", "layouts/P21.tif"])
def test_a_flipped_byte_of_a_raw_file_is_named(own_campaign: Path, name: str) -> None:
    flip(own_campaign / name)
    assert named(own_campaign) == f"raw file {name}: has changed since the build"


def test_a_missing_raw_file_is_named(own_campaign: Path) -> None:
    (own_campaign / "scans" / "P12.txt").unlink()
    assert "raw file scans/P12.txt: is not in" in named(own_campaign)


def test_verify_notes_that_raw_files_are_missing(own_campaign: Path) -> None:
    for name in ("layouts", "scans"):
        (own_campaign / name).rename(own_campaign / f"moved-{name}")
    result = verify(own_campaign / "prints.zarr")
    assert result.findings == ()
    assert "not checked" in result.notes[0]
    with pytest.raises(InputError, match="folder of raw files"):
        verify(own_campaign / "prints.zarr", data_dir=own_campaign / "absent")


@pytest.mark.parametrize("position", [0.02, 0.6])
@pytest.mark.parametrize(
    "chunks",
    [
        {
            "height_um/c/0/0/0": "height_um of scan P11",
            "mask_level/c/0/0/0": "mask_level of scan P11",
            "valid/c/0/0/0": "valid of scan P11",
            "scan_to_layout/c/0/0/0": "scan_to_layout of scan P11",
            "scans/P12/raw_height_um/c/0/0": "raw_height_um of scan P12",
            "scans/P12/removed_um/c/0/0": "removed_um of scan P12",
            "quality/ncc_after/c/0": "ncc_after",
        },
        # Without one of these columns, no scan can be checked.
        {"order/c/0": "order"},
        {"x_um/c/0": "x_um"},
    ],
    ids=["arrays", "order", "x_um"],
)
def test_every_flipped_byte_of_a_chunk_is_named(
    own_campaign: Path, chunks: dict[str, str], position: float
) -> None:
    for chunk in chunks:
        flip(own_campaign / "prints.zarr" / chunk, position)
    found = named(own_campaign)
    assert [name for name in chunks.values() if name not in found] == []


@pytest.mark.parametrize(
    "document",
    [
        "zarr.json",
        "height_um/zarr.json",
        "quality/zarr.json",
        "manifest/zarr.json",
        "scans/P11/removed_um/zarr.json",
    ],
)
def test_a_changed_digit_of_metadata_is_named(own_campaign: Path, document: str) -> None:
    path = own_campaign / "prints.zarr" / document
    text = path.read_text()
    # Change the first digit of a number, such as a shape, a version or a parameter.
    position = next(i for i, letter in enumerate(text) if letter.isdigit() and text[i - 1] in " [:")
    path.write_text(text[:position] + str((int(text[position]) + 1) % 10) + text[position + 1 :])
    assert named(own_campaign)


@pytest.mark.parametrize(
    "document",
    [
        "mask_level/zarr.json",
        "scans/P11/zarr.json",
        "quality/ncc_after/zarr.json",
        "manifest/sha256/zarr.json",
        "provenance/record/zarr.json",
    ],
)
@pytest.mark.parametrize("damage", ['{"a": ', '{"node_type": "sieve", "zarr_format": 3}'])
def test_a_metadata_document_that_zarr_cannot_read_is_named(
    own_campaign: Path, document: str, damage: str
) -> None:
    (own_campaign / "prints.zarr" / document).write_text(damage)
    assert f"metadata {document}" in named(own_campaign)


@pytest.mark.parametrize(
    ("key", "value"),
    [("levels", 14), ("license", "none"), ("dataset_sha256", "0" * 64), ("more", 1)],
)
def test_a_changed_attribute_is_named(own_campaign: Path, key: str, value: object) -> None:
    root = zarr.open_group(own_campaign / "prints.zarr", mode="a", use_consolidated=False)
    root.attrs[key] = value
    assert f"attribute {key}" in named(own_campaign)


def test_a_changed_pitch_contradicts_the_coordinates(own_campaign: Path) -> None:
    root = zarr.open_group(own_campaign / "prints.zarr", mode="a", use_consolidated=False)
    root.attrs["pitch_um"] = 0.2
    assert "got 0.05, 0.15, 0.25, …, wanted 0.1, 0.3, 0.5" in named(own_campaign)


def test_a_changed_parameter_of_a_step_is_named(own_campaign: Path) -> None:
    root = zarr.open_group(own_campaign / "prints.zarr", mode="a", use_consolidated=False)
    records = array_of(root, "provenance/record")
    texts = [str(text) for text in values_of(root, "provenance/record")]
    row = next(i for i, text in enumerate(texts) if json.loads(text)["op"] == "register" and i > 5)
    texts[row] = texts[row].replace('"seed":0', '"seed":1')
    records[...] = np.array(texts, dtype=object)
    found = named(own_campaign)
    assert "step register of scan P12: operation, parameters or inputs" in found
    assert "table provenance" in found


def test_values_that_decode_but_differ_are_named(own_campaign: Path) -> None:
    root = zarr.open_group(own_campaign / "prints.zarr", mode="a", use_consolidated=False)
    array_of(root, "height_um")[2, 10, 10] += 1e-3
    found = named(own_campaign)
    assert "height_um of scan P21: values differ from those that were built" in found
    assert "attribute dataset_sha256" in found
    assert "P11" not in found


def test_replay_reproduces_every_array(campaign: Path) -> None:
    table = replay(campaign / "prints.zarr", ["P12"])
    assert len(table) == 8
    assert (table["max_abs_difference"] == 0).all()
    assert table["same_hash"].all()
    one = replay(campaign / "prints.zarr", ["P11"], arrays=["height_um"])
    assert list(one["array"]) == ["height_um"]


def test_replay_measures_the_difference_of_a_changed_array(own_campaign: Path) -> None:
    root = zarr.open_group(own_campaign / "prints.zarr", mode="a", use_consolidated=False)
    before = float(values_of(root, "height_um")[0, 10, 10])
    array_of(root, "height_um")[0, 10, 10] = before + 0.125
    table = replay(own_campaign / "prints.zarr", ["P11"]).set_index("array")
    assert table["max_abs_difference"]["height_um"] == pytest.approx(0.125, abs=1e-7)  # float32 near 1 µm
    assert not table["same_hash"]["height_um"]
    assert table["same_hash"].drop("height_um").all()


def test_replay_refuses_other_raw_files_and_unknown_names(own_campaign: Path) -> None:
    path = own_campaign / "prints.zarr"
    with pytest.raises(InputError, match="wanted P11, P12, P21"):
        replay(path, ["P99"])
    with pytest.raises(InputError, match="array, got 'colour'"):
        replay(path, arrays=["colour"])
    flip(own_campaign / "scans" / "P11.txt")
    with pytest.raises(InputError, match=r"P11\.txt, got another SHA-256"):
        replay(path, ["P11"])


def test_history_reaches_the_raw_files(campaign: Path) -> None:
    text = history(campaign / "prints.zarr", "P12")
    order = [
        text.index(word) for word in ("layouts/P12.tif", "scans/P12.txt", "recipe", "scan_to_layout", "valid")
    ]
    assert order == sorted(order)
    assert 'with unit = "m"' in text
    overview = history(campaign / "prints.zarr").splitlines()
    assert [line.split(":")[0] for line in overview] == ["P11", "P12", "P21"]
    assert "scans/P11.txt" in overview[0]
    with pytest.raises(InputError, match="P99"):
        history(campaign / "prints.zarr", "P99")
