"""Generic terms for what has no name: where a residual lives, held out and against controls."""

from litho_models.loop.probes.probe import with_intervals
from litho_models.loop.probes.selection import AddedProbe, Probed, ProbeTest, probe_residual

__all__ = ["AddedProbe", "ProbeTest", "Probed", "probe_residual", "with_intervals"]
