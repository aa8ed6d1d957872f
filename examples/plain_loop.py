"""Find the hidden causes of a blind board in fifty lines, by ridge regression on the layout and on covariates
that stand for possible causes.

    litho-models board judge BOARD --loop "python examples/plain_loop.py" --out judged

Each scan is predicted by a ridge regression that is fitted to the other scans. A covariate has the name of
the effect for which it stands. The program names this effect if the covariate reduces the total squared error
by at least 1 %, and reduces the error of every scan except at most one.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
from scipy.ndimage import gaussian_filter

from litho_data import PrintedScan, open_store
from litho_models.boards.records import Answer, Found

STEP_PX, BLURS_PX, RIDGE, LEAST_GAIN = 4, (0, 2, 5, 12, 30), 1e-6, 0.01


def columns(scan: PrintedScan, order: float) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """Return the predictors that are always used, as an array of shape (pixels, predictors), and a dictionary
    with the covariate of each effect.
    """
    level = scan.mask_level / scan.levels
    blurred = [gaussian_filter(level, px) for px in BLURS_PX]
    y, x = (np.linspace(-1, 1, n) for n in level.shape)
    radius2 = y[:, None] ** 2 + x**2
    slope_y, slope_x = np.gradient(blurred[1])
    covariates = {
        "vignetting": blurred[1] * radius2,
        "field-curvature": (blurred[1] - blurred[2]) * radius2,
        "laser-drift": blurred[1] * order,
        "slope-thinning": np.hypot(slope_y, slope_x),
        "line-shortening": np.abs(slope_x),
        "galvo-lag": slope_x,
        "long-range-proximity": gaussian_filter(level, 80),
    }
    base = np.stack([*blurred, *(one**2 for one in blurred), blurred[1] ** 3], axis=-1)
    thin = scan.usable[::STEP_PX, ::STEP_PX]
    pick = {name: one[::STEP_PX, ::STEP_PX][thin] for name, one in covariates.items()}
    return base[::STEP_PX, ::STEP_PX][thin], pick


def errors_nm(maps: list[np.ndarray], heights: list[np.ndarray]) -> list[np.ndarray]:
    """Return the residuals of each scan in nm, as an array of shape (pixels,). They are those of a fit to the
    other scans, after an offset is fitted to each scan.
    """
    maps, heights = ([one - one.mean(axis=0) for one in own] for own in (maps, heights))
    grams, rights = ([a.T @ b for a, b in zip(maps, own, strict=True)] for own in (maps, heights))
    gram, right, found = sum(grams), sum(rights), []
    for own, height, less, part in zip(maps, heights, grams, rights, strict=True):
        rest = gram - less
        found.append(height - own @ np.linalg.solve(rest + RIDGE * np.diag(np.diag(rest)), right - part))
    return found


def plain_loop(store: Path, folder: Path) -> Answer:
    """Return the names of the covariates that reduce the error. They are added one by one, the best one
    first.
    """
    opened = open_store(store)
    scans = [scan for scan in opened.scans() if scan.id not in opened.locked_ids]
    made = [columns(scan, at / len(scans) - 0.5) for at, scan in enumerate(scans)]
    heights = [
        1e3 * scan.height_um[::STEP_PX, ::STEP_PX][scan.usable[::STEP_PX, ::STEP_PX]] for scan in scans
    ]
    maps = [base for base, _ in made]
    left, names = errors_nm(maps, heights), list[str]()
    before_nm = mean_absolute(left)
    while more := made[0][1].keys() - {*names}:
        wider = {
            name: [np.column_stack([own, all_[name]]) for own, (_, all_) in zip(maps, made, strict=True)]
            for name in more
        }
        tried = {name: errors_nm(own, heights) for name, own in wider.items()}
        best = min(tried, key=lambda name: sum(squares(tried[name])))
        gains = squares(left) - squares(tried[best])
        if sum(gains > 0) < len(scans) - 1 or sum(gains) < LEAST_GAIN * sum(squares(left)):
            break
        maps, left = wider[best], tried[best]
        names.append(best)
    found = [Found(names=[name], knowledge="cause") for name in names]
    return Answer(found=found, before_nm=before_nm, after_nm=mean_absolute(left))


def mean_absolute(residuals: list[np.ndarray]) -> float:
    """Return the mean absolute residual, averaged first over each scan and then over the scans."""
    return float(np.mean([np.abs(one).mean() for one in residuals]))


def squares(residuals: list[np.ndarray]) -> np.ndarray:
    """Return the mean squared residual of each scan, as an array of shape (scans,)."""
    return np.array([np.mean(one**2) for one in residuals])


if __name__ == "__main__":
    plain_loop(Path(sys.argv[1]), Path(sys.argv[2])).write(sys.argv[2])
