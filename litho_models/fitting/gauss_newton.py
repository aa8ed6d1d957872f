"""Models with few parameters, fitted to mean absolute error by damped Gauss-Newton.

The Jacobian comes from forward-mode differentiation, one column per parameter; the per-scan
nuisances are solved for in the same linear system; weights 1/sqrt(r² + δ²) turn the squares into
absolute values (iteratively reweighted least squares).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from litho_data.store import PrintedScan
from litho_models.fitting.crops import Window, cut, stack
from litho_models.scan_terms.nuisance import Policy
from litho_models.scan_terms.training import pinned_terms, training_basis
from litho_models.simulator import Simulator

ITERATIONS = 30
# A stiff model needs no more than a quarter of each scan: another quadrant from scan to scan.
WINDOW_PX = 256
THINNING_PX = 2
# Residuals below this count squared: far below the noise of a print (16 nm).
ABSOLUTE_WIDTH_UM = 0.002
RELATIVE_GAIN = 1e-4
DAMPING_START, DAMPING_LIMIT = 1e-3, 1e6
# Parameters are heights in µm, logits or logarithms: one step beyond a unit would leave the range in
# which the linearisation means anything, and a sigmoid's flat end is never left again.
STEP_LIMIT = 1.0


def fit_gauss_newton(
    model: Simulator, scans: Sequence[PrintedScan], policy: Policy, free_gain: bool = False
) -> list[float]:
    """Fit ``model`` in place on every second row and column of one window of each scan.

    Line offsets of ``full+rows`` are left out: they average out over a scan and cannot move a stiff model.

    Returns:
        mean absolute residual after each iteration, µm, nuisances taken out.
    """
    parameters = list(model.parameters())
    if not parameters:
        return []
    samples = [_Sample(scan, number) for number, scan in enumerate(scans)]
    vector = torch.nn.utils.parameters_to_vector(parameters).detach()
    terms = _Terms(policy, free_gain)
    nuisances = np.zeros((len(samples), terms.count))
    damping, losses = DAMPING_START, []
    for _ in range(ITERATIONS):
        equations = _NormalEquations.at(model, samples, nuisances, terms)
        while damping <= DAMPING_LIMIT:
            change, nuisance_change = equations.solve(damping)
            _load(parameters, vector + change)
            loss = _loss(model, samples, nuisances + nuisance_change)
            if loss <= equations.loss:
                break
            damping *= 10
        else:
            _load(parameters, vector)
            break
        vector, nuisances = vector + change, nuisances + nuisance_change
        damping = max(damping / 10, DAMPING_START)
        losses.append(loss)
        if equations.loss - loss < RELATIVE_GAIN * loss:
            break
    return losses


@dataclass(frozen=True)
class _Terms:
    """Which nuisances each scan has."""

    policy: Policy
    free_gain: bool

    @property
    def count(self) -> int:
        return len(self.basis(np.zeros((1, 1))))

    @property
    def pinned(self) -> int:
        return pinned_terms(self.policy, self.free_gain)

    def basis(self, prediction_um: np.ndarray) -> np.ndarray:
        return training_basis(prediction_um, self.policy, self.free_gain)


@dataclass(frozen=True)
class _NormalEquations:
    """Parameters first, then the nuisances of each scan, then the rows that pin offset and gain."""

    matrix: np.ndarray
    right: np.ndarray
    parameter_count: int
    nuisance_shape: tuple[int, int]
    loss: float
    step_limit: float

    @classmethod
    def at(
        cls, model: Simulator, samples: list[_Sample], nuisances: np.ndarray, terms: _Terms
    ) -> _NormalEquations:
        count = model.parameter_count
        pinned = terms.pinned
        size = count + nuisances.size
        matrix, right = np.zeros((size + pinned, size + pinned)), np.zeros(size + pinned)
        losses = []
        for number, sample in enumerate(samples):
            prediction, jacobian = sample.linearise(model)
            sample.basis = sample.thin(terms.basis(prediction))
            design = np.concatenate([sample.thin(jacobian), sample.basis])
            residual = sample.residual(prediction, nuisances[number])
            magnitude = _magnitude(residual)
            first = count + number * terms.count
            own = np.r_[0:count, first : first + terms.count]
            matrix[np.ix_(own, own)] += (design / magnitude) @ design.T / residual.size
            right[own] += design @ (residual / magnitude) / residual.size
            for term in range(pinned):
                matrix[size + term, first + term] = matrix[first + term, size + term] = 1
            losses.append(magnitude.mean())
        limit = np.inf if model.is_linear else STEP_LIMIT
        return cls(matrix, right, count, nuisances.shape, float(np.mean(losses)), limit)

    def solve(self, damping: float) -> tuple[Tensor, np.ndarray]:
        """Changes of the parameters, none above ``step_limit``, and of the nuisances (scans, terms)."""
        damped = self.matrix.copy()
        diagonal = np.arange(self.parameter_count)
        scale = damped[diagonal, diagonal]
        damped[diagonal, diagonal] += damping * np.maximum(scale, 1e-9 * scale.max())
        count = self.parameter_count
        step = np.linalg.lstsq(damped, self.right, rcond=1e-14)[0][:count]
        step = step.clip(-self.step_limit, self.step_limit)
        # The best nuisances for the step as it is taken, not as it was asked for.
        rest = self.right[count:] - self.matrix[count:, :count] @ step
        nuisances = np.linalg.lstsq(self.matrix[count:, count:], rest, rcond=1e-14)[0]
        scans, terms = self.nuisance_shape
        return torch.as_tensor(step, dtype=torch.float32), nuisances[: scans * terms].reshape(scans, terms)


class _Sample:
    """One window of a scan on every second row and column."""

    def __init__(self, scan: PrintedScan, number: int):
        size = min(WINDOW_PX, *scan.shape)
        row, column = divmod(number % 4, 2)
        y, x = ((length - size) * far for length, far in zip(scan.shape, (row, column), strict=True))
        self._window = Window(0, y, x, size)
        self._layout_um = scan.layout_um
        height = cut(scan.height_um, self._window)
        used = np.zeros(height.shape, bool)
        used[::THINNING_PX, ::THINNING_PX] = True
        self._used = used & cut(scan.valid, self._window) & np.isfinite(height)
        self._height = height[self._used].astype(np.float64)
        self.basis = np.empty((0, 0))
        self._expansion: tuple[np.ndarray, np.ndarray, np.ndarray] | None = None

    def linearise(self, model: Simulator) -> tuple[np.ndarray, np.ndarray]:
        """Height (y, x) and its derivatives (parameters, y, x); a linear model is differentiated once."""
        if model.is_linear and self._expansion is not None:
            return self.height_um(model), self._expansion[2]
        value, jacobian = _value_and_jacobian(model, self)
        if model.is_linear:
            self._expansion = _vector(model), value, jacobian
        return value, jacobian

    def height_um(self, model: Simulator) -> np.ndarray:
        """Height of the window (y, x), µm, float64."""
        if model.is_linear and self._expansion is not None:
            here, value, jacobian = self._expansion
            return value + np.tensordot(_vector(model) - here, jacobian, axes=1)
        with torch.no_grad():
            return self.predict(model).double().numpy()

    def predict(self, model: Simulator) -> Tensor:
        """Height of the window, (y, x) µm, its surroundings taken into account."""
        if model.reach_px is None:
            return model(stack([self._layout_um], [self._window]))[0, 0]
        return model.interior(stack([self._layout_um], [self._window], model.reach_px))[0, 0]

    def thin(self, fields: np.ndarray) -> np.ndarray:
        """(..., y, x) of the window to (..., used pixels)."""
        return fields[..., self._used]

    def residual(self, prediction_um: np.ndarray, coefficients: np.ndarray) -> np.ndarray:
        """Measured minus predicted minus nuisance at the used pixels, µm."""
        return self._height - self.thin(prediction_um) - coefficients @ self.basis


def _loss(model: Simulator, samples: list[_Sample], nuisances: np.ndarray) -> float:
    losses = []
    for sample, own in zip(samples, nuisances, strict=True):
        losses.append(_magnitude(sample.residual(sample.height_um(model), own)).mean())
    return float(np.mean(losses))


def _magnitude(residual_um: np.ndarray) -> np.ndarray:
    return np.sqrt(residual_um**2 + ABSOLUTE_WIDTH_UM**2)


def _load(parameters: list[torch.nn.Parameter], vector: Tensor) -> None:
    with torch.no_grad():
        torch.nn.utils.vector_to_parameters(vector, parameters)


def _value_and_jacobian(model: Simulator, sample: _Sample) -> tuple[np.ndarray, np.ndarray]:
    """Prediction (y, x) of the window and its derivatives (parameters, y, x), float64."""
    prediction = _WindowPrediction(model, sample)
    named = {f"model.{name}": parameter for name, parameter in model.named_parameters()}
    sizes = [parameter.numel() for parameter in named.values()]

    def predict(vector: Tensor) -> Tensor:
        parts = zip(named.items(), vector.split(sizes), strict=True)
        values = {name: part.reshape(parameter.shape) for (name, parameter), part in parts}
        return torch.func.functional_call(prediction, values, ())

    here = torch.nn.utils.parameters_to_vector(list(named.values())).detach()
    columns = [torch.func.jvp(predict, (here,), (direction,))[1] for direction in torch.eye(here.numel())]
    return sample.height_um(model), torch.stack(columns).detach().double().numpy()


def _vector(model: Simulator) -> np.ndarray:
    return torch.nn.utils.parameters_to_vector(list(model.parameters())).detach().double().numpy()


class _WindowPrediction(torch.nn.Module):
    """``sample.predict`` as a module, the form in which torch swaps parameters for tangents."""

    def __init__(self, model: Simulator, sample: _Sample):
        super().__init__()
        self.model = model
        self._sample = sample

    def forward(self) -> Tensor:
        return self._sample.predict(self.model)
