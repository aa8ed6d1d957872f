"""Check that the measurement model finds what was planted in all scans, and nothing else."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
import pytest
from numpy.polynomial import legendre

from litho_data.store import PrintedScan
from litho_models.scan_terms.measurement import LEVELLED, MeasurementModel, SharedPart
from litho_models.scan_terms.measurement_fit import learn_measurement
from tests.litho_models.loop_scans import PITCH_UM, blank_scans, with_heights

COUNT, SIZE_PX, NOISE_UM = 8, 48, 0.004
SIDE = np.linspace(-1, 1, SIZE_PX)
X, Y = SIDE[None, :] + 0 * SIDE[:, None], SIDE[:, None] + 0 * SIDE[None, :]
FIELD_UM = (SIZE_PX * PITCH_UM, SIZE_PX * PITCH_UM)
SCANS = blank_scans(COUNT, SIZE_PX)


def relief(
    number: int, shift_x_um: np.ndarray | float = 0.0, shift_y_um: np.ndarray | float = 0.0
) -> np.ndarray:
    """Return a print (ny, nx) in µm, a sum of waves that can be evaluated at displaced positions."""
    rng = np.random.default_rng([11, number])
    x = (np.arange(SIZE_PX) * PITCH_UM)[None, :] + shift_x_um
    y = (np.arange(SIZE_PX) * PITCH_UM)[:, None] + shift_y_um
    total = np.full((SIZE_PX, SIZE_PX), 0.6)
    for _ in range(12):
        fy, fx, phase = rng.uniform(-0.6, 0.6), rng.uniform(-0.6, 0.6), rng.uniform(0, 2 * np.pi)
        total = total + 0.08 * np.cos(2 * np.pi * (fy * y + fx * x) + phase)
    return total


PRINTS = [relief(number) for number in range(COUNT)]


def measured(
    seen: Callable[[int], np.ndarray], *, noise_um: float = NOISE_UM, seed: int = 0
) -> list[PrintedScan]:
    """Return scans of the heights ``seen(number)``, (ny, nx) in µm. Each scan has its own datum and white
    noise.
    """
    rng = np.random.default_rng(seed)
    noise = rng.normal(0, noise_um, (COUNT, SIZE_PX, SIZE_PX)) + rng.normal(0, 0.05, (COUNT, 1, 1))
    return with_heights(SCANS, [seen(number) + noise[number] for number in range(COUNT)])


def in_field(number: int, field: str) -> bool:
    return SCANS[number].groups["field"] == field


def part_of(model: MeasurementModel, what: str, by: str) -> SharedPart:
    return next(part for part in model.parts if (part.what, part.by) == (what, by))


def left_nm(
    scans: Sequence[PrintedScan], model: MeasurementModel, prints: Sequence[np.ndarray] = PRINTS
) -> float:
    """Return the rms of the residual in nm, after the datum of each scan is subtracted."""
    left = [scan.height_um - model.expected_um(scan, own) for scan, own in zip(scans, prints, strict=True)]
    # Exclude the edge, where a displaced print would have to be known beyond the field.
    return 1e3 * float(np.sqrt(np.mean([one[2:-2, 2:-2].var() for one in left])))


def levelled(field_um: np.ndarray, levelling: str) -> np.ndarray:
    """Subtract the surface that a levelling fits, such as a plane, but keep the mean."""
    powers = {1: X, 2: Y, 3: X**2, 4: X * Y, 5: Y**2}
    shapes = np.stack([np.ones_like(X), *(powers[k] for k in LEVELLED[levelling])]).reshape(  # type: ignore[index]
        1 + len(LEVELLED[levelling]),
        -1,  # type: ignore[index]
    )
    fitted = np.linalg.lstsq(shapes.T, field_um.reshape(-1), rcond=None)[0] @ shapes
    return field_um - fitted.reshape(field_um.shape) + fitted.mean()


@pytest.mark.parametrize("levelling", list(LEVELLED))
def test_predictions_are_levelled_as_the_files_were(levelling: str) -> None:
    scans = measured(lambda number: levelled(PRINTS[number], levelling))
    learned = learn_measurement(scans, PRINTS)
    assert learned.levelling == levelling
    # The residual is white noise. A surface learned from this noise adds less than one per cent.
    assert left_nm(scans, learned) == pytest.approx(1e3 * NOISE_UM, rel=0.02)


def test_a_levelled_prediction_has_none_of_the_surface_and_keeps_its_mean() -> None:
    for name in LEVELLED:
        found = made(levelling=name).expected_um(SCANS[0], PRINTS[0])
        np.testing.assert_allclose(found, levelled(PRINTS[0], name), atol=1e-12)


def background(number: int) -> np.ndarray:
    """Return the background in µm. In field 2, it is a bow along x plus a twist. In field 1, it is zero."""
    return (0.03 * legendre.legval(X, [0, 0, 1]) + 0.02 * X * Y) * in_field(number, "2")


@pytest.fixture(scope="module")
def with_background() -> list[PrintedScan]:
    return measured(lambda number: PRINTS[number] + background(number))


@pytest.fixture(scope="module")
def learned(with_background: list[PrintedScan]) -> MeasurementModel:
    return learn_measurement(with_background, PRINTS)


def test_a_background_by_field_is_found_to_within_its_noise(
    with_background: list[PrintedScan], learned: MeasurementModel
) -> None:
    # Shrinkage loses at most shrinking / (k + shrinking) of the background that k scans of a field share,
    # however often the fit is repeated. Half of it may be attributed to all scans, the rest to the field.
    shrinking = part_of(learned, "background", "field").shrinking
    lost = shrinking / (COUNT / 2 + shrinking) * background(1).std()
    # A part with p numbers fits the noise of p pixels in each field.
    noise = NOISE_UM * np.sqrt(2 * 35 / (COUNT * SIZE_PX**2))
    for number in range(COUNT):
        assert (learned.background_um(SCANS[number]) - background(number)).std() < lost + 2 * noise
    assert left_nm(with_background, learned) < 1e3 * NOISE_UM * 1.1


def test_what_one_group_has_leaves_every_other_scan_untouched(learned: MeasurementModel) -> None:
    elsewhere = replace(SCANS[0], groups={"field": "3"})
    common = learned.model_copy(update={"parts": [part for part in learned.parts if part.by != "field"]})
    assert np.array_equal(learned.expected_um(elsewhere, PRINTS[0]), common.expected_um(elsewhere, PRINTS[0]))
    assert np.array_equal(made(BY_FIELD).expected_um(elsewhere, PRINTS[0]), PRINTS[0])
    inside = made(BY_FIELD).expected_um(SCANS[1], PRINTS[1])
    np.testing.assert_allclose(inside, PRINTS[1] + 0.03 * X + 0.02 * Y, atol=1e-12)


@pytest.mark.parametrize("axis", ["x", "y"])
def test_a_displacement_in_one_field_is_found(axis: str) -> None:
    """Check scans that show the print at displaced positions, x + shift. The shift is S-shaped along x and
    smaller than a pixel.
    """
    size_um = 0.08
    shift = size_um * legendre.legval(X, [0, 0, 0, 1])

    def seen(number: int) -> np.ndarray:
        own = shift * in_field(number, "2")
        return relief(number, own) if axis == "x" else relief(number, 0.0, own)

    scans = measured(seen)
    learned = learn_measurement(scans, PRINTS)
    # Half of the shift may be attributed to all scans, the rest to the fields. Only the sum is compared.
    parts = [part for part in learned.parts if part.what == f"shift-{axis}"]
    assert "field" in {part.by for part in parts}
    kept = min(COUNT / 2 / (COUNT / 2 + part.shrinking) for part in parts)

    def total(field: str) -> np.ndarray:
        # The shapes are 1, x, y, P2(x), x y, P2(y), P3(x). The last one was planted.
        return np.sum([part.coefficients.get(field, part.coefficients.get("")) for part in parts], axis=0)

    # Slopes vary over the field, so the shapes are not quite independent. Allow a twentieth.
    assert total("2")[6] == pytest.approx(size_um, rel=0.05 + 1 - kept)
    assert np.abs(total("1")).max() < (0.05 + 1 - kept) * size_um
    assert left_nm(scans, learned) < 1e3 * NOISE_UM * 1.15 < 0.6 * left_nm(scans, made())


def test_a_gain_by_print_is_found() -> None:
    gains = {"1": 0.05, "2": -0.05, "3": 0.03, "4": -0.03}
    scans = measured(lambda number: PRINTS[number] * (1 + gains[SCANS[number].print_id]))
    part = part_of(learn_measurement(scans, PRINTS), "gain", "print")
    kept = 2 / (2 + part.shrinking)
    # Shrinkage uses the mean size of all reliefs, whose sizes differ. Allow a fifth.
    for label, gain in gains.items():
        assert part.coefficients[label][0] == pytest.approx(gain * kept, abs=0.2 * 0.05)


@pytest.mark.parametrize("seed", range(2))
def test_next_to_nothing_is_learned_from_noise(seed: int) -> None:
    scans = measured(lambda number: PRINTS[number], seed=seed)
    learned = learn_measurement(scans, PRINTS, seed=seed)
    added = [learned.expected_um(scan, own) - own for scan, own in zip(scans, PRINTS, strict=True)]
    # A part with p numbers fits the noise of p pixels. The largest has 35 numbers in each of 2 fields.
    limit_um = NOISE_UM * np.sqrt(2 * 35 / (COUNT * SIZE_PX**2))
    assert np.sqrt(np.mean([one.var() for one in added])) < 2 * limit_um
    # One of the parts that are tried may pass by chance.
    assert len(learned.parts) <= 1


def test_scans_that_did_not_take_part_are_freed_too(with_background: list[PrintedScan]) -> None:
    """Check that the background of a field, learned on three prints, predicts the background of the fourth
    print.
    """
    scans, prints = with_background[6:], PRINTS[6:]
    learned = learn_measurement(with_background[:6], PRINTS[:6])
    assert left_nm(scans, learned, prints) < 0.6 * left_nm(scans, made(), prints)


def made(*parts: SharedPart, **facts: object) -> MeasurementModel:
    return MeasurementModel.model_validate(
        {"levelling": "none", "parts": list(parts), "field_um": FIELD_UM, "scans": COUNT, **facts}
    )


def shared(what: str, by: str, degree: int, coefficients: dict[str, list[float]]) -> SharedPart:
    return SharedPart.model_validate(
        {"what": what, "by": by, "degree": degree, "shrinking": 0.3, "coefficients": coefficients}
    )


BY_FIELD = shared("background", "field", 1, {"1": [0.01, 0.0], "2": [0.03, 0.02]})


def test_between_groups_is_what_groups_differ_in() -> None:
    common = shared("background", "all", 1, {"": [0.5, 0.5]})
    gain = shared("gain", "print", 0, {"1": [0.1], "2": [-0.1]})
    model = made(common, BY_FIELD, gain, levelling="twist").between_groups()
    assert model.levelling == "none"
    assert [part.by for part in model.parts] == ["field"]
    np.testing.assert_allclose(model.background_um(SCANS[0]), -0.01 * X - 0.01 * Y, atol=1e-12)
    np.testing.assert_allclose(model.background_um(SCANS[1]), 0.01 * X + 0.01 * Y, atol=1e-12)


def test_a_field_of_another_size_has_its_levelling_alone() -> None:
    model = made(BY_FIELD, levelling="plane", field_um=(2 * FIELD_UM[0], FIELD_UM[1]))
    assert not model.fits(SCANS[0])
    np.testing.assert_allclose(
        model.expected_um(SCANS[0], PRINTS[0]), levelled(PRINTS[0], "plane"), atol=1e-12
    )


def test_fields_of_the_most_frequent_size_are_learned_from(
    with_background: list[PrintedScan], learned: MeasurementModel
) -> None:
    small = blank_scans(1, 24)[0]
    assert learn_measurement([small, *with_background], [small.layout_um, *PRINTS]) == learned
    assert learned.scans == COUNT


@pytest.mark.parametrize("count", [1, 2])
def test_one_or_two_scans_are_no_error(count: int) -> None:
    scans = measured(lambda number: PRINTS[number])[:count]
    learned = learn_measurement(scans, PRINTS[:count])
    assert left_nm(scans, learned, PRINTS[:count]) < 1e3 * NOISE_UM * 1.2


def test_unmeasured_pixels_take_no_part(with_background: list[PrintedScan]) -> None:
    hidden = []
    for scan in with_background[:4]:
        height, valid = scan.height_um.copy(), scan.valid.copy()
        height[:6], valid[:6] = np.nan, False
        hidden.append(replace(scan, height_um=height, valid=valid))
    garbage = [replace(s, height_um=np.where(s.valid, s.height_um, 1e6).astype(np.float32)) for s in hidden]
    assert learn_measurement(hidden, PRINTS[:4]) == learn_measurement(garbage, PRINTS[:4])


def test_the_record_says_how_many_numbers_it_has_and_reads_back() -> None:
    model = made(BY_FIELD, shared("gain", "print", 0, {"1": [0.1], "2": [-0.1]}))
    assert model.numbers == 6
    assert MeasurementModel.model_validate_json(model.model_dump_json()) == model
