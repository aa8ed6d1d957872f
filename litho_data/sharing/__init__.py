"""Distribute independent jobs over processes and machines."""
