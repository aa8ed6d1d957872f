"""Share independent jobs among processes and machines."""
