"""Score a finished design as models predict it, as an AFM measures it, or as a camera photographs it."""
