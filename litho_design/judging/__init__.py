"""Score a finished design by predictions of its print, by an AFM scan of the print, or by a photograph of its
light.
"""
