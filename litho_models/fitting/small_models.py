"""Fit small models to one window of each scan by least squares. Derivatives are computed by forward-mode
differentiation.
"""

import copy
from collections.abc import Sequence
from dataclasses import replace
from functools import partial

import numpy as np
import torch
from torch import Tensor, nn

from litho_data.commands.progress import progress
from litho_data.foundation.errors import InputError
from litho_data.foundation.kinds import Array
from litho_data.store import PrintedScan
from litho_models.fitting.crops import Window, cut, part_to_fit, stack
from litho_models.fitting.least_squares import Linearised, Room, Rules, fit_least_squares
from litho_models.scan_terms import Policy, TermPixels, Terms, term_maps
from litho_models.scan_terms.policies import PINNED, smooth_training_terms
from litho_models.simulator import Simulator

# A window with this side length, placed in one corner of each scan, contains enough pixels to fit a small
# model. Successive scans use different corners. If a corner has few measured pixels, the corner with the most
# measured pixels is used instead.
WINDOW_PX = 256
THINNING_PX = 2
# Largest step of a parameter. Its unit is µm for a height, and 1 for a raw number (see ``layers.ranges``).
# For larger steps, the linearisation is not valid.
STEP_LIMIT = 1.0
RULES = Rules("absolute", term_weight=0.0, steps=30, relative_gain=1e-4, tries=10, lowest_damping=1e-3)


def fit_small_model(model: Simulator, scans: Sequence[PrintedScan], policy: Policy) -> list[float]:
    """Fit ``model`` in place by minimising the mean absolute error. The fitted pixels are those in every
    second row and column of one window per scan.

    Line offsets, which the policy ``full+rows`` contains, are not fitted, because they average out over a
    scan and hardly affect a small model.

    Returns:
        The mean absolute residual after each step, µm, with the per-scan terms removed.
    """
    if not any(parameter.requires_grad for parameter in model.parameters()):
        return []
    terms = smooth_training_terms(policy)
    rules = replace(RULES, pinned=len(PINNED & terms))
    shown = partial(progress, what=f"fitting {model.name}")
    fitted = fit_least_squares(ModelProblem(model, scans, terms), fitted_numbers(model), rules, shown)
    load_numbers(model, fitted.vector)
    return fitted.losses


class ModelProblem:
    """The least-squares problem of fitting a model to one window of each scan. A copy of the model is used.

    Args:
        model: the model to fit; ``scans``: training scans; ``terms``: names of the terms that are fitted to
            each scan.
    """

    def __init__(self, model: Simulator, scans: Sequence[PrintedScan], terms: Terms):
        self._model = copy.deepcopy(model)
        self._samples = [_Sample(scan, number) for number, scan in enumerate(scans)]
        self._terms = terms

    def linearise(self, vector: Array) -> list[Linearised]:
        """Return all scans, linearised at the parameters ``vector``."""
        load_numbers(self._model, vector)
        return [sample.linearise(self._model, self._terms) for sample in self._samples]

    def residuals(self, vector: Array) -> list[Array]:
        """Return the measured minus predicted heights, µm: for each scan an array of shape (n,)."""
        load_numbers(self._model, vector)
        return [sample.residual(sample.height_um(self._model)) for sample in self._samples]

    def room(self, vector: Array) -> Room | None:
        """Return the smallest and largest step that keep all values inside the ranges of the model. Return
        None for a linear model, for which any step is allowed.
        """
        return None if self._model.is_linear else parameter_room(self._model, vector)


def parameter_room(model: nn.Module, vector: Array) -> Room:
    """Return the smallest and the largest step from ``vector`` that ``STEP_LIMIT`` and the ranges of the
    model allow. ``vector``, the smallest step and the largest step have shape (p,), with one entry per
    trainable number of the model.
    """
    ranges = model.ranges if isinstance(model, Simulator) else {}
    free = (-np.inf, np.inf)
    ends = [
        ranges[name].raw_ends if name in ranges else free
        for name, parameter in model.named_parameters()
        if parameter.requires_grad
        for _ in range(parameter.numel())
    ]
    lowest, highest = np.reshape(ends, (-1, 2)).T - vector
    return np.clip(lowest, -STEP_LIMIT, 0), np.clip(highest, 0, STEP_LIMIT)


class _Sample:
    """The fitted pixels of one scan: those in every second row and column of one window."""

    def __init__(self, scan: PrintedScan, number: int):
        self._window = _corner(scan, number % 4)
        self._exposed_um = scan.exposed_um
        height = cut(scan.height_um, self._window)
        used = np.zeros(height.shape, bool)
        used[::THINNING_PX, ::THINNING_PX] = True
        self._used = np.flatnonzero(used & cut(scan.usable, self._window))
        if not self._used.size:
            raise InputError(f"corners of scan {scan.id}", got="no measured pixel", wanted="at least one")
        self._height = height.reshape(-1)[self._used].astype(np.float64)
        self._expansion: tuple[Array, Array, Array] | None = None

    def linearise(self, model: Simulator, terms: Terms) -> Linearised:
        """Linearise the scan at the present parameters of the model. A linear model is differentiated only
        once.
        """
        if model.is_linear and self._expansion is not None:
            height, jacobian = self.height_um(model), self._expansion[2]
        else:
            height, jacobian = self.height_um(model), _jacobian(model, self)
            if model.is_linear:
                self._expansion = fitted_numbers(model).astype(np.float64), height, jacobian
        basis = term_maps(TermPixels(height, at=self._used), terms)
        return Linearised(self.residual(height), self._thinned(jacobian), basis)

    def height_um(self, model: Simulator) -> Array:
        """Return the predicted height of the window, µm, as a float64 array of shape (ny, nx)."""
        if model.is_linear and self._expansion is not None:
            here, value, jacobian = self._expansion
            return value + np.tensordot(fitted_numbers(model) - here, jacobian, axes=1)
        with torch.no_grad():
            return self.predict(model).double().numpy()

    def predict(self, model: Simulator) -> Tensor:
        """Predict the height of the window, µm, from the layout of the window and its surroundings. The
        result has shape (ny, nx).
        """
        if model.reach_px is None:
            return model(stack([self._exposed_um], [self._window]))[0, 0]
        return model.interior(stack([self._exposed_um], [self._window], model.reach_px))[0, 0]

    def residual(self, height_um: Array) -> Array:
        """Return measured minus predicted heights at the fitted pixels, µm, of shape (n,)."""
        return self._height - self._thinned(height_um)

    def _thinned(self, fields: Array) -> Array:
        return fields.reshape(*fields.shape[:-2], -1)[..., self._used]


def _corner(scan: PrintedScan, usual: int) -> Window:
    """Return the window in which a scan is fitted. The window lies in corner number ``usual`` of the scan. If
    this corner has too few measured pixels, the window lies in the corner with the most measured pixels.
    """
    size = min(WINDOW_PX, *scan.shape)
    last_y, last_x = (length - size for length in scan.shape)
    corners = [Window(0, y, x, size) for y in (0, last_y) for x in (0, last_x)]
    counts = [int(cut(scan.usable, corner).sum()) for corner in corners]
    return corners[part_to_fit(counts, usual)]


def _jacobian(model: Simulator, sample: _Sample) -> Array:
    """Return the derivatives of the window's predicted height with respect to all trainable parameters,
    computed in one forward-mode pass. The result is float64 of shape (parameters, ny, nx).
    """
    prediction = _WindowPrediction(model, sample)
    named = {f"model.{name}": one for name, one in model.named_parameters() if one.requires_grad}
    sizes = [parameter.numel() for parameter in named.values()]

    def predict(vector: Tensor) -> Tensor:
        parts = zip(named.items(), vector.split(sizes), strict=True)
        values = {name: part.reshape(parameter.shape) for (name, parameter), part in parts}
        return torch.func.functional_call(prediction, values, ())

    here = torch.nn.utils.parameters_to_vector(list(named.values())).detach()
    # ``torch.func.jacfwd`` gives the same numbers in up to three times the time.
    found = torch.autograd.functional.jacobian(predict, here, strategy="forward-mode", vectorize=True)
    return found.movedim(-1, 0).detach().double().numpy()


def _fitted(model: nn.Module) -> list[nn.Parameter]:
    return [parameter for parameter in model.parameters() if parameter.requires_grad]


def fitted_numbers(model: nn.Module) -> Array:
    return torch.nn.utils.parameters_to_vector(_fitted(model)).detach().numpy().copy()


def load_numbers(model: nn.Module, vector: Array) -> None:
    with torch.no_grad():
        torch.nn.utils.vector_to_parameters(torch.as_tensor(vector, dtype=torch.float32), _fitted(model))


class _WindowPrediction(nn.Module):
    """A torch module that calls ``sample.predict``. For forward-mode derivatives, torch must replace the
    parameters of the model. Torch can do so only if the call is itself a module.
    """

    def __init__(self, model: Simulator, sample: _Sample):
        super().__init__()
        self.model = model
        self._sample = sample

    def forward(self) -> Tensor:
        return self._sample.predict(self.model)
