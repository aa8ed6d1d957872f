"""Multi-level diffractive lenses that focus light directly, or that form images which are then
deconvolved.
"""
