"""How good a print is: predicted, measured, photographed, over a process window."""
