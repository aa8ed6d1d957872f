"""Heights of whole fields, tile by tile."""
