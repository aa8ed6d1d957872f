"""Heights of whole fields: tiles, their consistency, and what a prediction costs."""
