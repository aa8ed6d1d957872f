"""Scores of a finished design: as predicted by models, as measured, as photographed."""
