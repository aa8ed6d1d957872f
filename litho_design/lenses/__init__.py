"""Multi-level diffractive lenses: direct focusing, and imaging with deconvolution."""
